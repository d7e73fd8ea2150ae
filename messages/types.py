"""Define the messages of all topics except the scene, which `flexsheet.messages.scene` defines.

Positions and directions are in the world frame, unless the name contains another frame. Arrays
never contain NaN. A field such as `valid` states whether a quantity is known.

Two robot arms hold a rubber sheet in front of the user. The target pose of the sheet follows the
user's fingertip over the virtual object.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flexsheet.messages import methods
from flexsheet.messages.arrays import (
    ArraySpec,
    ColorImage,
    EyePair,
    GrayImage,
    Matrix6,
    Points3,
    Transform,
    Triangles,
    Vector2,
    Vector3,
    Vector6,
)
from flexsheet.messages.base import Message, MessagePart, Stamp
from flexsheet.messages.notes import Note
from flexsheet.messages.scene import Finite, NonNegative, Positive

Correction = methods.Correction
Side = Literal["left", "right"]
Pattern = Literal[
    "object", "grid", "checker", "white", "black", "coordinate_ramp_x", "coordinate_ramp_y"
]
Shading = Literal["soft", "flat"]
StereoMode = Literal["mono", "side_by_side", "top_bottom", "frame_sequential", "anaglyph"]


class StereoPair(Message):
    """A pair of images of the stereo camera.

    The source timestamp is the midpoint of the exposure. If the two cameras have no common trigger,
    the timestamp is the mean of the midpoints of both exposures.
    """

    device: str
    exposure_s: NonNegative
    skew_s: Finite = Field(
        default=0.0,
        description="measured time of the right exposure minus time of the left exposure, s",
    )
    dropped_frames: int = Field(
        ge=0, description="number of frames that the camera has lost since its start"
    )
    left_origin_px: tuple[int, int] = Field(
        default=(0, 0), description="column and row of the left image's first pixel on the sensor"
    )
    right_origin_px: tuple[int, int] = (0, 0)
    left: GrayImage
    right: GrayImage


FingertipReason = Literal[
    "ok",
    "no_marker",
    "marker_in_one_view",
    "two_markers",
    "merged",
    "blurred",
    "saturated",
    "outside_volume",
    "inconsistent",
    "too_fast",
    "unconfirmed",
]
"""The reason why no fingertip position was computed from an image pair; "ok" if one was computed.

no_marker: no marker was found.
marker_in_one_view: only one camera sees the marker.
two_markers: there are several possible markers.
merged: the marker's image touches another bright spot.
blurred: the marker moves too fast for the exposure.
saturated: the marker is overexposed.
outside_volume: the marker is outside the finger's possible positions.
inconsistent: the rays of the two cameras do not intersect.
too_fast: the marker is faster than a finger.
unconfirmed: there are too few detections for a track.
"""

FingertipState = Literal["lost", "acquiring", "tracking", "coasting"]
"""The state of the track of the fingertip.

lost: there is no track.
acquiring: a track has begun, but is not yet confirmed.
tracking: the current image pair confirms the track.
coasting: the position is only predicted.
"""


class Fingertip(Message):
    """The position of the fingertip at the exposure of an image pair, and its predicted path.

    If `valid` is false, `reason` states the cause. While `state` is "coasting", position and
    velocity are predicted from the last valid measurement. `measured_world_m` is the unfiltered
    position that was triangulated from this image pair.
    """

    valid: bool
    state: FingertipState
    reason: FingertipReason
    position_world_m: Vector3
    velocity_world_m_per_s: Vector3
    covariance: Matrix6 = Field(description="covariance matrix of position (m) and velocity (m/s)")
    predicted_path_world_m: Annotated[NDArray[np.float64], ArraySpec("<f8", ("points", 3))] = Field(
        description="predicted positions at the exposure and every prediction_step_s later, m"
    )
    prediction_step_s: Positive
    measured_world_m: Vector3
    reprojection_px: NonNegative


Phase = Literal["wait", "approach", "contact", "hold"]

SheetReason = Literal[
    "ok",
    "fingertip_invalid",
    "fingertip_not_finite",
    "fingertip_too_old",
    "fingertip_in_future",
    "implausible_input",
    "ambiguous_side",
    "through_object",
    "past_object_edge",
    "beyond_tilt",
    "beyond_spin",
    "past_sheet_width",
    "past_sheet_height",
    "concave_contact",
]
"""The reason why the sheet does not follow the finger; "ok" while the sheet follows.

If the reason is "concave_contact", the sheet follows the finger at a distance.
"""


class SheetTrajectory(MessagePart):
    """The planned motion of the sheet after its target pose, if no newer target arrives.

    The sheet keeps the target's velocity (twist) for `keep_s`, and then decelerates uniformly to
    rest.
    """

    keep_s: float = Field(
        ge=0.0, le=0.2, description="time for which the target's velocity is kept, s"
    )
    brake_s: float = Field(
        gt=0.0, le=0.2, description="duration of the uniform deceleration that follows, s"
    )


class SheetTarget(Message):
    """The target pose and velocity of the sheet at the time `valid_at_ns`.

    The sheet frame has its origin at the sheet's centre. The x axis points from the left to the
    right edge, and the z axis points towards the user. For another time, a node extrapolates the
    pose with the velocity (twist), or follows `trajectory`.
    """

    phase: Phase
    reason: SheetReason = Field(
        description='reason why the sheet stops or waits; "ok" if it does neither'
    )
    valid_at_ns: Stamp = Field(
        description="time of this pose, on the clock of the header's timestamps"
    )
    world_from_sheet: Transform
    twist_world: Vector6 = Field(
        description="linear velocity of the sheet's centre (m/s), then angular velocity (rad/s)"
    )
    stretch_ratio: Positive = Field(
        description="distance between the clamped edges divided by the unstretched width"
    )
    trajectory: SheetTrajectory | None = Field(
        default=None,
        description="motion of the sheet after `valid_at_ns`; None: both arms extrapolate the "
        "pose with the velocity",
    )
    contact_world_m: Vector3 = Field(description="contact point on the undeformed object")
    normal_world: Vector3
    contact_sheet_m: Vector2 = Field(description="contact point on the sheet (x, y), sheet frame")
    push_depth_m: NonNegative = Field(
        description="depth of the fingertip below the surface of the undeformed object"
    )
    normal_offset_m: Finite = Field(
        default=0.0,
        description="distance of the sheet's surface behind the object's tangent plane, at which "
        "the sheet exerts the object's force on the finger; negative: in front. The clamped edges "
        "are further behind by the sag of the sheet",
    )


ArmMode = Literal[
    "disconnected", "idle", "follow", "hold", "stopping", "fault", "relax", "estop", "starting"
]
"""The operating mode of an arm.

In the mode "starting", the arm's controller has not answered since the arm's node started.
"""


class ArmState(Message):
    """The state of one arm. The source timestamp is the time of the joint measurement."""

    side: Side
    mode: ArmMode
    faults: tuple[str, ...]
    ready: bool = Field(
        default=False,
        description="true: the arm is armed and may move",
    )
    estop_engaged: bool = Field(
        default=False,
        description="true: an e-stop is latched, and the arm does not move at all",
    )
    reason: str = Field(
        default="",
        description="reason why the arm does not follow the target; empty if the arm follows it",
    )
    path_blocked: bool = Field(
        default=False,
        description="true: the arm rests because every path to the target is blocked; `reason` "
        "contains the cause",
    )
    auto_arming: bool = Field(
        default=False,
        description="true: the arm is armed automatically, without a command of the operator",
    )
    joints_rad: Vector6
    joints_commanded_rad: Vector6
    world_from_flange: Transform
    world_from_flange_commanded: Transform
    command_age_s: NonNegative | None = Field(
        description="age of the sheet target that the arm follows, s; None: there is no target"
    )
    target_source_ns: Stamp = Field(
        description="time of the camera exposure from which this sheet target was computed; 0: "
        "there is no target"
    )
    trajectory_ends_ns: Stamp = Field(
        default=0,
        description="time until which the arm may follow the target's trajectory; 0: the arm "
        "follows no trajectory",
    )
    command_sent_ns: Stamp = Field(
        description="time of the newest command to the arm; 0: no command was sent"
    )
    edge_distance_m: NonNegative | None = Field(
        description="distance between both clamped edges of the sheet; None: unknown"
    )
    edge_force_n: NonNegative | None
    cycle_s: NonNegative = Field(
        description="duration of the last exchange of data with the arm's controller"
    )
    servo_lag_s: NonNegative | None = Field(
        default=None,
        description="assumed time by which the arm lags behind its commands; None: unknown",
    )
    servo_lag_uncertainty_s: NonNegative | None = Field(
        default=None,
        description="standard deviation of the measured servo lag; None: the lag is not measured",
    )


class ArmLatency(Message):
    """The mean latency of one arm for the newest sheet targets that the arm has followed."""

    side: Side
    latency_s: Finite = Field(
        description="time from a camera exposure until the first command for the resulting sheet "
        "target, plus the arm's measured lag"
    )


class Skin(Message):
    """The surface mesh of the undeformed soft body, published once for each object.

    The normals of the triangles point outwards.
    """

    mesh_id: str
    vertices_world_m: Points3
    triangles: Triangles


ForceCurve = Annotated[NDArray[np.float64], ArraySpec("<f8", ("depths", 2))]


class SoftBody(Message):
    """The deformation of the soft body under the finger, and the body's force on the finger."""

    mesh_id: str
    method: str
    in_range: bool = Field(description="false: the push is outside the method's range of validity")
    push_depth_m: NonNegative
    force_world_n: Vector3 = Field(description="force of the object on the finger")
    stiffness_n_per_m: NonNegative = Field(description="stiffness of the object at the finger")
    force_curve: ForceCurve = Field(
        default_factory=lambda: np.zeros((0, 2)),
        description="force of the object at the finger, with or without contact: rows of depth (m) "
        "and force (N), both starting at 0 and non-decreasing; empty: unknown",
    )
    prediction_horizon_s: NonNegative = Field(
        default=0.0,
        description="time from the exposure to the predicted finger position of this response, s",
    )
    force_error_ratio: NonNegative = Field(
        default=0.0,
        description="relative error of the force at `push_depth_m`, as stated by the method; "
        "0: the error is unknown",
    )
    displacement_world_m: Points3


class Force(Message):
    """The force of the finger on the sheet, as measured by a sensor of the user.

    The source timestamp is the time of the measurement.
    """

    valid: bool = Field(description="false: the sensor gives no usable value")
    force_n: Finite = Field(
        description="force along the sheet's normal, positive away from the user, N; the last "
        "valid force if `valid` is false"
    )
    standard_deviation_n: NonNegative = Field(
        description="standard deviation of noise and calibration error, N"
    )


class Eye(Message):
    """The positions of the user's eyes, measured by a head tracker.

    If there is no head tracker, nodes use the positions in the scene.
    """

    valid: bool = Field(
        description="false: the eyes are not detected; the other fields hold the last valid values"
    )
    centre_world_m: Vector3 = Field(description="midpoint between both eyes")
    right_world: Vector3 = Field(
        default_factory=lambda: np.array([1.0, 0.0, 0.0]),
        description="direction from the left to the right eye, of any length except zero",
    )


class Display(Message):
    """The display settings of the renderer, published by the console or by an experiment."""

    correction: Correction
    stereo: StereoMode
    swap_eyes: bool = False
    shading: Shading = "soft"
    pattern: Pattern = Field(
        default="object",
        description="grid, checker, white: 300 mm square on the imaginary screen, with a line or "
        "field every 20 mm; coordinate_ramp_x, coordinate_ramp_y: the object, coloured by its "
        "position on the imaginary screen",
    )
    marks: bool = Field(
        default=True,
        description="true: marks are drawn at the target's contact point and at the fingertip",
    )
    pixels_every: int = Field(
        default=0,
        ge=0,
        description="number n: each nth frame contains its pixels; 0: no frame contains pixels",
    )
    label: str = Field(
        default="", description="label that is copied to each frame drawn with these settings"
    )


class Frame(Message):
    """An image that the renderer draws for the projector.

    The source timestamp is the exposure of the camera image from which the frame was computed.
    """

    number: int
    correction: Correction
    stereo: StereoMode
    label: str
    pattern: Pattern = Field(default="object", description="pattern of the display settings")
    eyes_world_m: EyePair = Field(description="positions of the left and right eye, m")
    world_from_sheet: Transform
    pushed_point_world_m: Vector3
    predicted_to_ns: Stamp = Field(
        description="expected display time, for which the positions were predicted"
    )
    draw_s: NonNegative
    late_frames: int = Field(
        ge=0,
        description="number of frames that were displayed more than half a period later than "
        "predicted",
    )
    eye: Literal["both", "left", "right"] = Field(
        default="both",
        description="eye for which the frame is drawn; left or right if frames alternate",
    )
    drawn_ns: Stamp = Field(
        default=0, description="time when the graphics card had finished the frame"
    )
    swapped_ns: Stamp = Field(
        default=0,
        description="time when the window showed the frame; 0: the renderer has no window",
    )
    light_ns: Stamp = Field(
        default=0,
        description="measured time of the middle of the frame's display; assumed if the renderer "
        "has no window",
    )
    shaped_for_ns: Stamp = Field(
        default=0,
        description="time of the finger position that deforms the object; 0: the object is at rest",
    )
    fingertip_world_m: Annotated[NDArray[np.float64], ArraySpec("<f8", ("points", 3))] = Field(
        default_factory=lambda: np.zeros((0, 3)),
        description="predicted fingertip position at `predicted_to_ns`, m; no row if it is unknown",
    )
    occluded_fraction: NonNegative = Field(
        default=0.0,
        description="fraction of the sheet's visible area that is unlit because of folds",
    )
    pixels: tuple[ColorImage, ...] = Field(
        description="projector image (mono or packed stereo), top row first; empty if the "
        "message has no image"
    )


class EStop(Message):
    """A command that engages (`engaged` is true) or resets the software e-stop of both arms.

    An engaged e-stop remains active until it is reset.
    """

    engaged: bool
    reason: str


class Recording(Message):
    """A command to start or stop recording, for recorders with the parameter `start_paused`."""

    running: bool


class Bookmark(Message):
    """A label for a time in a bag. The source timestamp of this message is the labelled time."""

    label: str = Field(max_length=200)


class Arming(Message):
    """A command of the operator that permits or ends motion of the robot arms.

    If `ready` is true, the arms may move. If `ready` is false, the arms stop and relax the sheet.
    After any stop, the arms rest until the next command.
    """

    ready: bool
    reason: str = ""


class PortStatus(MessagePart):
    """The statistics of one input or output of a node.

    The rate is the mean of the last second. Messages are counted from the start of the node.
    """

    topic: str
    rate_hz: NonNegative
    age_s: NonNegative | None = Field(
        description="age of the newest message since its source timestamp, s"
    )
    messages: int = Field(ge=0)
    dropped: int = Field(
        ge=0,
        description="number of messages that were replaced by newer messages, or lost by an "
        "overflow, before the node read them",
    )
    gaps: int = Field(
        ge=0,
        description="number of messages lost in transport, according to their sequence numbers",
    )
    rejected: int = Field(
        ge=0, description="number of messages that are malformed or of another type"
    )


class ClockEcho(MessagePart):
    """A reply of a clock node to the newest ping from the clock node of another host."""

    clock_id: str
    sent_ns: int = Field(
        ge=0, description="publish timestamp of the ping, on the clock of its sender"
    )
    received_ns: int = Field(
        ge=0, description="arrival time of the ping, on the clock of this message's header"
    )


class ClockPing(Message):
    """A message between the clock nodes of two hosts to measure the offset between their clocks.

    A round trip has four timestamps. An echo contains two of them. The other two are the publish
    timestamp in the header and the time of arrival.
    """

    echoes: tuple[ClockEcho, ...]


class ClockOffset(MessagePart):
    """The offset between the clock of another computer and the clock of the message's header.

    at_ns: time at which the offset was measured.
    offset_ns: time of the other clock minus time of the header's clock.
    """

    clock_id: str
    at_ns: int = Field(ge=0)
    offset_ns: int
    uncertainty_s: NonNegative = Field(description="maximum error of the offset")
    drift_ratio: Finite = Field(
        description="rate of the other clock divided by the rate of the header's clock, minus one"
    )
    resets: int = Field(ge=0, description="number of detected jumps of the clock")


class Clocks(Message):
    """The offsets of the clocks of other hosts.

    The clock node of a host sends this message to the nodes of the same host.
    """

    max_offset_uncertainty_s: Positive = Field(
        description="uncertainty of an offset (s) above which no arm moves"
    )
    max_drift_ratio: Positive = Field(
        description="maximum relative difference between the rates of two clocks"
    )
    offsets: tuple[ClockOffset, ...]


SuspectedCause = Literal[
    "camera_moved",
    "cameras_misaligned",
    "marker_offset",
    "servo_lag",
    "arm_not_following",
    "sheet_stiffness",
]
"""The suspected cause of a deviation between a measured and an expected value.

`flexsheet.messages.notes` describes each cause.
"""


class SelfCheck(MessagePart):
    """A comparison of a measured value with the value that a node expects."""

    cause: SuspectedCause
    subject: str = Field(default="", description="device that was checked, if there are several")
    unit: Literal["m", "s", "px", "rad", "N/m"]
    value: Finite = Field(description="measured value, averaged over several seconds")
    expected: Finite = Field(description="value if everything is as assumed")
    threshold: Positive = Field(
        description="deviation of value from expected that hardware within its tolerances can have"
    )
    suspected: bool = Field(description="true: the deviation exceeds the threshold persistently")


class Status(Message):
    """The state of a node. Each node publishes its state once per second."""

    node: str
    state: Literal["starting", "running", "degraded", "stopping"]
    pid: int
    uptime_s: NonNegative
    cpu_ratio: NonNegative
    resident_bytes: int = Field(ge=0)
    inputs: tuple[PortStatus, ...]
    outputs: tuple[PortStatus, ...]
    errors: int = Field(ge=0)
    last_error: str
    notes: tuple[Note, ...] = ()
    plan_hash: str
    clock_id: str = ""
    clock_offsets: tuple[ClockOffset, ...] = Field(
        default=(), description="measured offsets of the other clocks"
    )
    execution_log: Annotated[NDArray[np.int64], ArraySpec("<i8", ("steps", 4))] = Field(
        default_factory=lambda: np.zeros((0, 4), np.int64),
        description="handler calls since the last status (in the first seconds: since the start) "
        "in order, for `bag verify`. Columns: index of the input from 0, or of the timer as -1, "
        "-2, ...; message's sequence number; its writer's epoch; time of the call, ns",
    )
    self_checks: tuple[SelfCheck, ...] = Field(
        default=(), description="checks of the node that already have data"
    )
    changed_parameters: str = Field(
        default="{}", description="parameters changed since the start, as a JSON object"
    )

    @property
    def note_text(self) -> str:
        """Return the notes for people, on one line."""
        return "; ".join(map(str, self.notes))


class ParameterChange(Message):
    """A request to change a parameter of a running node (`flexsheet param set`)."""

    node: str
    parameter: str
    value: str = Field(description="new value as JSON")


class NodeProcess(MessagePart):
    """The state of a node's process, as observed by the launcher that started it."""

    name: str
    state: Literal["starting", "ready", "exited"] = Field(
        description="exited: the process has ended; it is restarted if that is allowed"
    )
    restarts: int = Field(ge=0)
    hangs: int = Field(ge=0, description="number of restarts because of a missing heartbeat")


class NodeOmission(MessagePart):
    """A node in the launch file that the launcher does not start, and the reason."""

    name: str
    reason: Literal["rigid_object", "no_image", "no_reader", "no_writer"] = Field(
        description="rigid_object, no_image: the scene has no material or no projector; no_reader, "
        "no_writer: no node of the graph reads its topics or writes its inputs"
    )


class HostKey(MessagePart):
    """The public key of a host, as known to the host that sends the message."""

    host: str
    key: str


class HostStatus(Message):
    """The state of a computer. The launcher on the computer publishes it once per second."""

    host: str
    run: str = Field(description="identifier of the run")
    plan_hash: str
    code: str = Field(description="commit of the code; + marks local changes")
    python: str
    uptime_s: NonNegative
    load_ratio: NonNegative = Field(
        description="load average of the last minute divided by the number of cores"
    )
    disk_free_bytes: int = Field(
        ge=0,
        description="free space on the disk of the recorder's folder; on a host without a "
        "recorder, on the disk of the working folder",
    )
    memory_free_bytes: int = Field(ge=0)
    nodes: tuple[NodeProcess, ...]
    omitted: tuple[NodeOmission, ...] = Field(
        default=(), description="nodes of the launch file that are not started"
    )
    missing_devices: tuple[str, ...] = Field(
        description="devices that the nodes of the host need and that are missing"
    )
    software: str = Field(
        default="", description="versions of software that must agree between hosts"
    )
    keys: tuple[HostKey, ...] = Field(
        default=(), description="keys of the hosts that this host accepts"
    )
    estop: str | None = Field(
        default=None, description="reason of the latched e-stop; None: no e-stop is latched"
    )


PathJoin = Literal["rounded_lines", "spline"]


MAX_PATH_COORDINATE_M = 2.0
"""The maximum coordinate of a finger path (m). A larger one is probably in mm."""

HandNoise = Annotated[float, Field(ge=0.0, le=0.02)]
"""The amplitude of a random motion of the finger (m). That of a hand is below 1 mm."""


class FingerPath(Message):
    """A path of the simulated finger. The finger first moves smoothly to the first point."""

    label: str
    times_s: Annotated[NDArray[np.float64], ArraySpec("<f8", ("points",))]
    positions_world_m: Annotated[NDArray[np.float64], ArraySpec("<f8", ("points", 3))]
    wander_m: HandNoise = Field(default=0.0, description="rms of slow random position errors, m")
    tremor_m: HandNoise = Field(
        default=0.0, description="amplitude of the simulated hand tremor from 8 to 12 Hz, m"
    )
    joined_by: PathJoin = Field(
        default="rounded_lines",
        description="rounded_lines: points are corners, rounded over +-40 ms; spline: points "
        "are samples of a smooth motion that begins and ends at rest",
    )

    def find_problem(self) -> str:
        """Return why the path is not valid, or "".

        One increasing time per point is required, and each point must be near the screen.
        """
        times_s, points = self.times_s, len(self.positions_world_m)
        if len(times_s) != points or points == 0:
            return (
                f"times_s: {len(times_s)} times for {points} points in positions_world_m; give "
                "one time per point, and at least one point"
            )
        wrong = np.flatnonzero(np.diff(times_s) <= 0.0)
        if len(wrong):
            at = int(wrong[0])
            return (
                f"times_s[{at + 1}]: {times_s[at + 1]:.6g} does not come after times_s[{at}] = "
                f"{times_s[at]:.6g}; give increasing times"
            )
        far = np.flatnonzero(~(np.abs(self.positions_world_m).max(axis=1) <= MAX_PATH_COORDINATE_M))
        if len(far):
            at = int(far[0])
            return (
                f"positions_world_m[{at}]: {self.positions_world_m[at].tolist()} m is more than "
                f"{MAX_PATH_COORDINATE_M:g} m from the centre of the screen; give positions in "
                "metres (20 mm are 0.02)"
            )
        return ""


class TwinFinger(Message):
    """The true position and velocity of the simulated fingertip at the source timestamp."""

    path_label: str
    path_done: bool
    path_time_s: Finite = Field(
        description="time since the start of the path; negative before the first point"
    )
    position_world_m: Vector3
    velocity_world_m_per_s: Vector3
    force_world_n: Vector3 = Field(
        default_factory=lambda: np.zeros(3),
        description="force of the sheet on the simulated finger, N, if forces move the hand; 0 if "
        "the finger follows its path regardless of forces",
    )


class TwinArms(Message):
    """The true joint angles and flange poses of both simulated arms at the source timestamp."""

    joints_left_rad: Vector6
    joints_right_rad: Vector6
    world_from_flange_left: Transform
    world_from_flange_right: Transform


Viewpoint = Literal["centre", "left", "right"]


class TwinEye(Message):
    """An image that an eye sees in the simulation, and the image that the eye should see."""

    label: str
    correction: Correction
    viewpoint: Viewpoint = Field(
        default="centre", description="midpoint between the eyes, or one eye"
    )
    metres_per_px: Positive = Field(
        description="size of a pixel in the plane of the imaginary screen"
    )
    seen: ColorImage
    expected: ColorImage
