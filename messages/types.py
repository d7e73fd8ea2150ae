"""Define the messages of all topics except the scene (`flexsheet.messages.scene`).

Positions and directions are in the world frame unless the name contains another frame.  A field
marks an unknown quantity; arrays never contain NaN.
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
from flexsheet.messages.scene import Finite, NonNegative, Positive

Correction = methods.Correction
Side = Literal["left", "right"]
Pattern = Literal[
    "object", "grid", "checker", "white", "black", "coordinate_ramp_x", "coordinate_ramp_y"
]
Shading = Literal["soft", "flat"]
StereoMode = Literal["mono", "side_by_side", "top_bottom", "frame_sequential", "anaglyph"]


class StereoPair(Message):
    """Pair of images; the header's source stamp is the middle of the exposure.

    For cameras without a common trigger, it is the middle between both exposures.
    """

    device: str
    exposure_s: NonNegative
    skew_s: Finite = Field(
        default=0.0, description="measured time of the right exposure minus that of the left, s"
    )
    dropped_frames: int = Field(ge=0, description="frames that the device has lost since its start")
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
"""Why an image pair gave no fingertip: no marker; a marker in one view only; several candidates; a
marker merged with another light; blurred; overexposed; outside the finger's volume; rays that do
not intersect; faster than a finger; too few detections for a track."""

FingertipState = Literal["lost", "acquiring", "tracking", "coasting"]
"""State of the track: none; tentative; confirmed by this image pair; predicted only."""


class Fingertip(Message):
    """Fingertip at the exposure, and its predicted path.

    If `valid` is false, `reason` gives the cause, and while `state` is "coasting" the tracked state
    is predicted from the last valid one.  `measured_world_m` is the triangulated point of this
    image pair, unfiltered.
    """

    valid: bool
    state: FingertipState
    reason: FingertipReason
    position_world_m: Vector3
    velocity_world_m_per_s: Vector3
    covariance: Matrix6 = Field(description="covariance of (position, velocity), m and m/s")
    predicted_path_world_m: Annotated[NDArray[np.float64], ArraySpec("<f8", ("points", 3))] = Field(
        description="predicted fingertip at the exposure and every prediction_step_s after it, m"
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
"""Why the sheet does not follow the finger; with "concave_contact" it follows at a distance."""


class SheetTrajectory(MessagePart):
    """Motion of the sheet after its target, while no newer target arrives.

    The sheet keeps the target's twist, and then decelerates evenly to rest.
    """

    keep_s: float = Field(ge=0.0, le=0.2, description="time for which the twist is kept")
    brake_s: float = Field(gt=0.0, le=0.2, description="duration of the deceleration after it")


class SheetTarget(Message):
    """Target pose and velocity of the sheet at `valid_at_ns`.

    The sheet frame is at the sheet's centre: x from the left edge to the right, z towards the user.
    For another time, a consumer extrapolates by the twist, or follows the trajectory.
    """

    phase: Phase
    reason: SheetReason = Field(description='why the sheet stops or waits; otherwise "ok"')
    valid_at_ns: Stamp = Field(
        description="time of the target, on the clock of the header's stamps"
    )
    world_from_sheet: Transform
    twist_world: Vector6 = Field(
        description="linear velocity (m/s) of the centre, then angular velocity (rad/s)"
    )
    stretch_ratio: Positive = Field(description="distance of the edges over the slack width")
    trajectory: SheetTrajectory | None = Field(
        default=None,
        description="motion that both arms may follow from valid_at_ns; None: they extrapolate",
    )
    contact_world_m: Vector3 = Field(description="contact point on the undeformed object")
    normal_world: Vector3
    contact_sheet_m: Vector2 = Field(description="the same point on the sheet (x, y)")
    push_depth_m: NonNegative = Field(description="depth of the finger in the undeformed object")
    normal_offset_m: Finite = Field(
        default=0.0,
        description="distance of the sheet's surface behind the object's tangent plane, where it "
        "has the object's force; negative: in front of it. The edges are further behind by the sag",
    )


ArmMode = Literal[
    "disconnected", "idle", "follow", "hold", "stopping", "fault", "relax", "estop", "starting"
]
"""Mode of an arm; "starting": no answer since the start of its bridge."""


class ArmState(Message):
    """State of one arm; the source stamp is the time of the joint measurement."""

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
        default="", description="why the arm does not follow the target; empty if it does"
    )
    path_blocked: bool = Field(
        default=False,
        description="true: the arm rests because every path to the target is blocked; reason gives "
        "the cause",
    )
    auto_arming: bool = Field(
        default=False, description="true: the arm arms itself without a command of the operator"
    )
    joints_rad: Vector6
    joints_commanded_rad: Vector6
    world_from_flange: Transform
    world_from_flange_commanded: Transform
    command_age_s: NonNegative | None = Field(
        description="age of the sheet target in use; None: no target"
    )
    target_source_ns: Stamp = Field(description="exposure of the image behind that target; 0: none")
    trajectory_ends_ns: Stamp = Field(
        default=0,
        description="time until which the arm may follow that target's trajectory; 0: not at all",
    )
    command_sent_ns: Stamp = Field(description="time of the newest command; 0: never")
    edge_distance_m: NonNegative | None = Field(
        description="distance between both edges; None: unknown"
    )
    edge_force_n: NonNegative | None
    cycle_s: NonNegative = Field(description="duration of the last exchange with the arm")
    servo_lag_s: NonNegative | None = Field(
        default=None, description="lag of the arm behind its commands, in use; None: unknown"
    )
    servo_lag_uncertainty_s: NonNegative | None = Field(
        default=None,
        description="standard deviation of the measured lag; None: the lag is not measured",
    )


class ArmLatency(Message):
    """Mean latency of one arm over its last sheet targets, while it follows them."""

    side: Side
    latency_s: Finite = Field(
        description="time from the exposure until the first command with its target, plus the "
        "arm's measured lag"
    )


class Skin(Message):
    """Skin of the soft body at rest, published once per object; normals point outwards."""

    mesh_id: str
    vertices_world_m: Points3
    triangles: Triangles


ForceCurve = Annotated[NDArray[np.float64], ArraySpec("<f8", ("depths", 2))]


class SoftBody(Message):
    """The response of the skin to the finger."""

    mesh_id: str
    method: str
    in_range: bool = Field(description="false: the push is outside the method's range of validity")
    push_depth_m: NonNegative
    force_world_n: Vector3 = Field(description="force of the object on the finger")
    stiffness_n_per_m: NonNegative = Field(description="stiffness of the object at the finger")
    force_curve: ForceCurve = Field(
        default_factory=lambda: np.zeros((0, 2)),
        description="force of the object at the finger, with or without contact: rows of depth (m) "
        "and force (N), both from 0 and never falling; empty: unknown",
    )
    prediction_horizon_s: NonNegative = Field(
        default=0.0, description="time from the exposure to the predicted finger of this response"
    )
    displacement_world_m: Points3


class Eye(Message):
    """Position of the user's eyes from a head tracker; without one, the scene's `eyes` are used."""

    valid: bool = Field(
        description="false: the eyes are not detected; the other fields are the last valid ones"
    )
    centre_world_m: Vector3 = Field(description="midpoint between both eyes")
    right_world: Vector3 = Field(
        default_factory=lambda: np.array([1.0, 0.0, 0.0]),
        description="direction from the left to the right eye, of any length except zero",
    )


class Display(Message):
    """Settings of the renderer, from console or experiment; latched."""

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
    marks: bool = Field(default=True, description="draw marks at the target and at the fingertip")
    pixels_every: int = Field(
        default=0, ge=0, description="attach pixels to each nth frame; 0: none"
    )
    label: str = Field(
        default="", description="label of each frame that is drawn with these settings"
    )


class Frame(Message):
    """Frame for the projector; the source stamp is the exposure behind its content."""

    number: int
    correction: Correction
    stereo: StereoMode
    label: str
    eyes_world_m: EyePair = Field(description="left and right eye, m")
    world_from_sheet: Transform
    pushed_point_world_m: Vector3
    predicted_to_ns: Stamp = Field(description="time for which the frame was drawn")
    draw_s: NonNegative
    late_frames: int = Field(
        ge=0, description="frames that were displayed more than half a period later than predicted"
    )
    eye: Literal["both", "left", "right"] = Field(
        default="both", description="eye of the frame; left or right if frames alternate"
    )
    drawn_ns: Stamp = Field(
        default=0, description="time when the graphics card had finished the frame"
    )
    swapped_ns: Stamp = Field(
        default=0, description="time when the window showed the frame; 0: no window"
    )
    light_ns: Stamp = Field(
        default=0, description="middle of the display time, measured; without a window: assumed"
    )
    shaped_for_ns: Stamp = Field(
        default=0,
        description="time of the finger that deforms the object; 0: the object is at rest",
    )
    fingertip_world_m: Annotated[NDArray[np.float64], ArraySpec("<f8", ("points", 3))] = Field(
        default_factory=lambda: np.zeros((0, 3)),
        description="predicted finger at `predicted_to_ns`, m; no row: unknown",
    )
    occluded_fraction: NonNegative = Field(
        default=0.0,
        description="fraction of the sheet's visible area that is unlit because of folds",
    )
    pixels: tuple[ColorImage, ...] = Field(
        description="projector images, top row first: none, or one (mono or packed stereo)"
    )


class EStop(Message):
    """Emergency stop by software, which bridges latch; `engaged` false resets it at rest."""

    engaged: bool
    reason: str


class Recording(Message):
    """Start or stop of a recording, for recorders with `start_paused`; a start opens a new bag."""

    running: bool


class Bookmark(Message):
    """Marked time in a bag, which is the source stamp."""

    label: str = Field(max_length=200)


class Arming(Message):
    """Operator's command to arm the arms, or (`ready` false) to stop them and relax the sheet.

    After any stop the arms rest until the next command.
    """

    ready: bool
    reason: str = ""


class PortStatus(MessagePart):
    """Statistics of one port of a node: rate over the last second, counts since its start."""

    topic: str
    rate_hz: NonNegative
    age_s: NonNegative | None = Field(description="age of the newest message by its source stamp")
    messages: int = Field(ge=0)
    dropped: int = Field(
        ge=0, description="messages superseded, or lost by an overflow, before the node read them"
    )
    gaps: int = Field(ge=0, description="messages lost in transport, by sequence numbers")
    rejected: int = Field(ge=0, description="messages that are malformed or of another type")


class ClockEcho(MessagePart):
    """Newest ping from another clock."""

    clock_id: str
    sent_ns: int = Field(ge=0, description="publish stamp of the ping, on its own clock")
    received_ns: int = Field(
        ge=0, description="time of its arrival, on the clock of this message's header"
    )


class ClockPing(Message):
    """Ping between the clock nodes of two hosts.

    An echo, the header's publish stamp and the time of arrival are the four stamps of a round trip.
    """

    echoes: tuple[ClockEcho, ...]


class ClockOffset(MessagePart):
    """Time of another clock minus that of the header's clock, at `at_ns` of the latter."""

    clock_id: str
    at_ns: int = Field(ge=0)
    offset_ns: int
    uncertainty_s: NonNegative = Field(description="maximum error of the offset")
    drift_ratio: Finite = Field(description="rate of the other clock over the header's, minus one")
    resets: int = Field(ge=0, description="number of detected steps of the clock")


class Clocks(Message):
    """Offsets of the other clocks, from a host's clock node for the nodes of that host."""

    max_offset_uncertainty_s: Positive = Field(
        description="limit of the uncertainty above which no arm moves"
    )
    max_drift_ratio: Positive = Field(description="maximum relative rate between two clocks")
    offsets: tuple[ClockOffset, ...]


SuspectedCause = Literal[
    "camera_moved",
    "cameras_misaligned",
    "marker_offset",
    "servo_lag",
    "arm_not_following",
    "sheet_stiffness",
]
"""Explanation of a residual: the stereo camera is not where the scene says; one of its two cameras
has moved against the other; the marker is not at the assumed offset from the finger's pad; an arm
lags more or less than configured; an arm does not do the commanded motion; the calibrated sheet is
not as stiff as the scene states."""


class SelfCheck(MessagePart):
    """Residual that shows continuously whether what a node assumes is still true."""

    cause: SuspectedCause
    subject: str = Field(default="", description="device concerned, if there are several")
    unit: Literal["m", "s", "px", "rad", "N/m"]
    value: Finite = Field(description="measured, mean over some seconds")
    expected: Finite = Field(description="value if everything is as assumed")
    threshold: Positive = Field(description="maximum deviation of an apparatus in tolerance")
    suspected: bool = Field(description="true: the deviation exceeds the threshold persistently")


class Status(Message):
    """State of a node, published once per second."""

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
    note: str = Field(description="note of the node, one line")
    plan_hash: str
    clock_id: str = ""
    clock_offsets: tuple[ClockOffset, ...] = Field(
        default=(), description="measured offsets of the other clocks"
    )
    execution_log: Annotated[NDArray[np.int64], ArraySpec("<i8", ("steps", 4))] = Field(
        default_factory=lambda: np.zeros((0, 4), np.int64),
        description="handler calls since the last status (in the first seconds: since the start) "
        "in order, for `bag verify`. Columns: input from 0, or timer -1, -2, ...; sequence of the "
        "message; epoch of its writer; time of the call, ns",
    )
    self_checks: tuple[SelfCheck, ...] = Field(
        default=(), description="residuals of the node that have data"
    )
    changed_parameters: str = Field(
        default="{}", description="parameters changed since the start, as a JSON object"
    )


class ParameterChange(Message):
    """Change of a parameter of a running node, from `flexsheet param set`."""

    node: str
    parameter: str
    value: str = Field(description="new value as JSON")


class NodeProcess(MessagePart):
    """State of a node's process, from its launcher."""

    name: str
    state: Literal["starting", "ready", "exited"] = Field(
        description="exited: the process has ended; it is restarted if that is allowed"
    )
    restarts: int = Field(ge=0)
    hangs: int = Field(ge=0, description="restarts because of a missing heartbeat")


class NodeOmission(MessagePart):
    """Node of the launch file that is not started."""

    name: str
    reason: Literal["rigid_object", "no_image", "no_reader", "no_writer"] = Field(
        description="rigid_object, no_image: the scene has no material or no projector; no_reader, "
        "no_writer: no node of the graph reads its topics or writes its inputs"
    )


class HostKey(MessagePart):
    """Public key of a host, as another host has it."""

    host: str
    key: str


class ProgramCpu(MessagePart):
    """Processor time of all processes with one name."""

    name: str = Field(description="name of the node, or of another program")
    cores: NonNegative = Field(description="processor time over elapsed time")


class CpuPressure(MessagePart):
    """Waiting time of a computer's nodes for a free processor, over the last seconds.

    It covers nodes with a `nice` value below 10.
    """

    busy: bool = Field(description="`wait_ratio` is above a quarter")
    wait_ratio: NonNegative = Field(description="maximum waiting time of a node over elapsed time")
    node: str = Field(description="node with this waiting time")
    programs: tuple[ProgramCpu, ...] = Field(
        default=(),
        description="programs with most processor time, the largest first; only while busy",
    )


class HostStatus(Message):
    """State of a computer, published by its launcher once per second."""

    host: str
    run: str = Field(description="identifier of the run")
    plan_hash: str
    code: str = Field(description="commit of the code; + marks local changes")
    python: str
    uptime_s: NonNegative
    load_ratio: NonNegative = Field(description="load of the last minute over the number of cores")
    disk_free_bytes: int = Field(ge=0, description="free space for bags, or in the working folder")
    memory_free_bytes: int = Field(ge=0)
    nodes: tuple[NodeProcess, ...]
    omitted: tuple[NodeOmission, ...] = Field(
        default=(), description="nodes of the launch file that are not started"
    )
    missing_devices: tuple[str, ...] = Field(description="missing devices of its nodes")
    software: str = Field(
        default="", description="versions of software that must agree between hosts"
    )
    keys: tuple[HostKey, ...] = Field(default=(), description="keys of the hosts that it accepts")
    estop: str | None = Field(default=None, description="reason of the latched e-stop; None: none")
    cpu: CpuPressure | None = Field(
        default=None, description="None: the system does not measure it, or no node runs yet"
    )


PathJoin = Literal["rounded_lines", "spline"]


class FingerPath(Message):
    """Path for the simulated finger, which first moves smoothly to the first point."""

    label: str
    times_s: Annotated[NDArray[np.float64], ArraySpec("<f8", ("points",))]
    positions_world_m: Annotated[NDArray[np.float64], ArraySpec("<f8", ("points", 3))]
    wander_m: NonNegative = Field(description="standard deviation of the slow human error")
    tremor_m: NonNegative = Field(description="amplitude of 8-12 Hz tremor")
    joined_by: PathJoin = Field(
        default="rounded_lines",
        description="rounded_lines: points are corners, rounded over +-40 ms; spline: points "
        "are samples of a smooth motion that begins and ends at rest",
    )
    stroke_s: Positive | None = Field(
        default=None, description="duration of motion, if the path is a stroke of the experiment"
    )


class TwinFinger(Message):
    """True fingertip at the source stamp."""

    path_label: str
    path_done: bool
    path_time_s: Finite = Field(
        description="time since the start of the path; negative before the first point"
    )
    path_stroke_s: Positive | None = Field(default=None, description="`stroke_s` of the path")
    position_world_m: Vector3
    velocity_world_m_per_s: Vector3


class TwinArms(Message):
    """True joint angles and flange poses of both arms at the source time stamp."""

    joints_left_rad: Vector6
    joints_right_rad: Vector6
    world_from_flange_left: Transform
    world_from_flange_right: Transform


Viewpoint = Literal["centre", "left", "right"]


class TwinEye(Message):
    """Image of a measuring camera at V or at an eye, and the expected image."""

    label: str
    correction: Correction
    viewpoint: Viewpoint = Field(
        default="centre", description="midpoint between the eyes, or one eye"
    )
    metres_per_px: Positive = Field(description="size of a pixel on the imaginary screen")
    seen: ColorImage
    expected: ColorImage
