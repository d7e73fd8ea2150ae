"""The message of every topic but the scene (`flexsheet.messages.scene`).

Positions and directions are in the world frame unless the name says otherwise.  When a quantity is
not known the message says so by a field; an array never holds NaN.
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
    """Two pictures taken together.  The header's source stamp is the middle of the exposure.

    Where the two cameras have no common trigger, it is the middle between both exposures.
    """

    device: str
    exposure_s: NonNegative
    skew_s: Finite = Field(
        default=0.0, description="exposure of the right picture minus that of the left, as measured"
    )
    dropped_frames: int = Field(ge=0, description="frames lost in the device since start")
    left_origin_px: tuple[int, int] = Field(
        default=(0, 0), description="column and row of the sensor where the left picture begins"
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
marker merged with another light; blurred; overexposed; outside the finger's volume; views that are
not of one point; faster than a finger; too few detections to begin a track."""

FingertipState = Literal["lost", "acquiring", "tracking", "coasting"]
"""State of the track: none; too new to be used; confirmed by this image pair; predicted for a while
without a detection."""


class Fingertip(Message):
    """Report the fingertip at the exposure, and its predicted path.

    When `valid` is false, `reason` says why, and the tracked state is predicted from the last
    valid one while `state` is "coasting".  `measured_world_m` is the triangulated point of this
    image pair, without any filter.
    """

    valid: bool
    state: FingertipState
    reason: FingertipReason
    position_world_m: Vector3
    velocity_world_m_per_s: Vector3
    covariance: Matrix6 = Field(description="covariance of (position, velocity), m and m/s")
    predicted_path_world_m: Annotated[NDArray[np.float64], ArraySpec("<f8", ("points", 3))] = Field(
        description="predicted fingertip at the exposure and every prediction_step_s after it"
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
"""Why the sheet does not follow the finger; "concave_contact": it follows with a distance."""


class SheetTarget(Message):
    """Command the sheet's pose at `valid_at_ns`, and its motion there.

    The sheet frame sits at the sheet's centre: x from the left edge to the right, z towards the
    user.  A consumer that uses it at another time adds twist times the difference.
    """

    phase: Phase
    reason: SheetReason = Field(description='why the sheet holds or waits; otherwise "ok"')
    valid_at_ns: Stamp = Field(description="on the clock of the header's stamps")
    world_from_sheet: Transform
    twist_world: Vector6 = Field(description="linear (m/s) of the centre, then angular (rad/s)")
    stretch_ratio: Positive = Field(description="distance of the edges over the slack width")
    contact_world_m: Vector3 = Field(description="point of the undeformed object that is presented")
    normal_world: Vector3
    contact_sheet_m: Vector2 = Field(description="the same point on the sheet (x, y)")
    push_depth_m: NonNegative = Field(description="of the finger in the undeformed object")
    normal_offset_m: Finite = Field(
        default=0.0,
        description="distance of the sheet behind the object's tangent plane, at which it has the "
        "object's force; negative: in front of it",
    )


ArmMode = Literal[
    "disconnected", "idle", "follow", "hold", "stopping", "fault", "relax", "estop", "starting"
]
"""Mode of an arm; in "starting" the arm has not answered since its bridge was started."""


class ArmState(Message):
    """One arm as its bridge sees it; the source stamp is when the joints were measured."""

    side: Side
    mode: ArmMode
    faults: tuple[str, ...]
    ready: bool = Field(
        default=False,
        description="it may move: it has been armed, and no interlock has disarmed it since",
    )
    estop_engaged: bool = Field(
        default=False,
        description="the bridge holds an e-stop; nothing moves, not even to slacken the sheet",
    )
    reason: str = Field(default="", description="why it does not follow; empty otherwise")
    path_blocked: bool = Field(
        default=False,
        description="it rests because no path to the sheet's target is clear and within its "
        "limits; reason says what blocks it",
    )
    auto_arming: bool = Field(
        default=False, description="it arms itself, without a person's command"
    )
    joints_rad: Vector6
    joints_commanded_rad: Vector6
    world_from_flange: Transform
    world_from_flange_commanded: Transform
    command_age_s: NonNegative | None = Field(description="of the sheet target in use; None: none")
    target_source_ns: Stamp = Field(
        description="exposure of the picture behind that target; 0: none"
    )
    command_sent_ns: Stamp = Field(description="when the newest command was written; 0: never")
    edge_distance_m: NonNegative | None = Field(description="between both edges; None: unknown")
    edge_force_n: NonNegative | None
    cycle_s: NonNegative = Field(description="duration of the last exchange with the arm")


class Skin(Message):
    """The soft body's skin at rest, once per object; triangles wind outwards."""

    mesh_id: str
    vertices_world_m: Points3
    triangles: Triangles


ForceCurve = Annotated[NDArray[np.float64], ArraySpec("<f8", ("depths", 2))]


class SoftBody(Message):
    """The response of the skin to the finger."""

    mesh_id: str
    method: str
    in_range: bool = Field(description="false: the push is outside the method's range")
    push_depth_m: NonNegative
    force_world_n: Vector3 = Field(description="of the object on the finger")
    stiffness_n_per_m: NonNegative = Field(description="of the object where the finger is")
    force_curve: ForceCurve = Field(
        default_factory=lambda: np.zeros((0, 2)),
        description="of the object where the finger is, whether it touches or not: rows of depth "
        "(m) and force (N), both from 0 and never falling; empty: not known",
    )
    prediction_horizon_s: NonNegative = Field(
        default=0.0, description="from the exposure to the predicted finger of this response"
    )
    displacement_world_m: Points3


class Eye(Message):
    """Where the user's eyes are, from whatever tracks his head; the scene's `eyes` without it."""

    valid: bool = Field(description="false: not seen; the rest is the last that was")
    centre_world_m: Vector3 = Field(description="midway between both eyes")
    right_world: Vector3 = Field(
        default_factory=lambda: np.array([1.0, 0.0, 0.0]),
        description="from the left eye to the right one, of any length but zero",
    )


class Display(Message):
    """What the renderer shall show; latched, from console or experiment."""

    correction: Correction
    stereo: StereoMode
    swap_eyes: bool = False
    shading: Shading = "soft"
    pattern: Pattern = Field(
        default="object",
        description="grid, checker, white: 300 mm square on the imaginary screen, every 20 mm a "
        "line or a change; coordinate_ramp_x, coordinate_ramp_y: the object, coloured by the "
        "position at which the eye should see it",
    )
    marks: bool = Field(default=True, description="draw the target mark and the fingertip mark")
    pixels_every: int = Field(
        default=0, ge=0, description="attach pixels to each nth frame; 0: none"
    )
    label: str = Field(default="", description="copied into each frame drawn with these settings")


class Frame(Message):
    """What the projector was given; the source stamp is the exposure behind what it shows."""

    number: int
    correction: Correction
    stereo: StereoMode
    label: str
    eyes_world_m: EyePair = Field(description="left, right")
    world_from_sheet: Transform
    pushed_point_world_m: Vector3
    predicted_to_ns: Stamp = Field(description="the instant that the picture was drawn for")
    draw_s: NonNegative
    late_frames: int = Field(
        ge=0, description="whose light was later than predicted by more than half a frame"
    )
    eye: Literal["both", "left", "right"] = Field(
        default="both", description="whose picture it is: one eye's, where frames alternate"
    )
    drawn_ns: Stamp = Field(default=0, description="when the graphics card was through with it")
    swapped_ns: Stamp = Field(default=0, description="when the window showed it; 0: no window did")
    light_ns: Stamp = Field(
        default=0, description="the middle of its light, as measured; without a window: assumed"
    )
    shaped_for_ns: Stamp = Field(
        default=0, description="the instant whose finger dents the object; 0: it is at rest"
    )
    fingertip_world_m: Annotated[NDArray[np.float64], ArraySpec("<f8", ("points", 3))] = Field(
        default_factory=lambda: np.zeros((0, 3)),
        description="where the finger was taken to be at `predicted_to_ns`; none: not known",
    )
    occluded_fraction: NonNegative = Field(
        default=0.0, description="fraction of the sheet's visible area without light, in folds"
    )
    pixels: tuple[ColorImage, ...] = Field(
        description="projector images, top row first: none, one (mono or packed)"
    )


class EStop(Message):
    """Emergency stop by software.  Bridges latch it; `engaged` false clears it, at rest only."""

    engaged: bool
    reason: str


class Recording(Message):
    """Whether a recorder that waits for it is to record; each start opens a bag of its own."""

    running: bool


class Bookmark(Message):
    """Mark a time to find again in a bag; the source stamp is that time."""

    label: str = Field(max_length=200)


class Arming(Message):
    """A person's word that the arms may move (or, false, shall stop and let the sheet go).

    After whatever has stopped them they stay where they are until somebody says so again.
    """

    ready: bool
    reason: str = ""


class PortStatus(MessagePart):
    """One input or output of a node over the last second and since its start."""

    topic: str
    rate_hz: NonNegative
    age_s: NonNegative | None = Field(description="of the newest message, from its source stamp")
    messages: int = Field(ge=0)
    dropped: int = Field(ge=0, description="superseded or overflown before the node saw them")
    gaps: int = Field(ge=0, description="lost on the way, by sequence numbers")
    rejected: int = Field(ge=0, description="malformed or of another type")


class ClockEcho(MessagePart):
    """The newest ping that came from another clock."""

    clock_id: str
    sent_ns: int = Field(ge=0, description="its publish stamp, on its own clock")
    received_ns: int = Field(ge=0, description="on the clock of this message's header")


class ClockPing(Message):
    """From each host's clock node to the others; with the header's publish stamp and the moment of
    its arrival, an echo in it is a ping of four stamps."""

    echoes: tuple[ClockEcho, ...]


class ClockOffset(MessagePart):
    """What another clock shows, less the clock of the header, when that shows `at_ns`."""

    clock_id: str
    at_ns: int = Field(ge=0)
    offset_ns: int
    uncertainty_s: NonNegative = Field(description="it is surely within so much of that")
    drift_ratio: Finite = Field(description="by how much it gains on the header's clock")
    resets: int = Field(ge=0, description="how often it was found to have been stepped")


class Clocks(Message):
    """What a host's clock node knows of the other clocks, for the nodes of its host."""

    max_offset_uncertainty_s: Positive = Field(description="beyond it no arm moves")
    max_drift_ratio: Positive = Field(description="by how much a clock may gain on another")
    offsets: tuple[ClockOffset, ...]


class Status(Message):
    """How a node is; each node sends one a second."""

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
    note: str = Field(description="what the node itself wants to say, one line")
    plan_hash: str
    clock_id: str = ""
    clock_offsets: tuple[ClockOffset, ...] = Field(
        default=(), description="of the other clocks that it hears, as it knows them"
    )
    execution_log: Annotated[NDArray[np.int64], ArraySpec("<i8", ("steps", 4))] = Field(
        default_factory=lambda: np.zeros((0, 4), np.int64),
        description="handler calls since the last status (in the first seconds: since the "
        "start), in order, for `bag verify`. Columns: input, counted from 0, or timer, -1, -2, "
        "...; the message's sequence; its writer's epoch; time of the call, ns",
    )


class NodeProcess(MessagePart):
    """A node as its launcher knows it."""

    name: str
    state: Literal["starting", "ready", "exited"] = Field(
        description="exited: it has ended, and is restarted unless it may not"
    )
    restarts: int = Field(ge=0)
    hangs: int = Field(ge=0, description="restarts because it gave no sign of life")


class HostKey(MessagePart):
    """A host's public key, as another one knows it."""

    host: str
    key: str


class ProgramCpu(MessagePart):
    """The processor time of all processes of one name."""

    name: str = Field(description="of the node, for nodes of the graph; else the program's")
    cores: NonNegative = Field(description="processor time over time passed")


class CpuPressure(MessagePart):
    """How long the nodes of a computer were ready to run while no processor was free.

    Over the last seconds, of the nodes that do not give way to all others (`nice` below 10).
    """

    busy: bool = Field(description="`wait_ratio` is above a quarter")
    wait_ratio: NonNegative = Field(
        description="of the node that waited longest: time ready to run but not running, over time"
    )
    node: str = Field(description="that node")
    programs: tuple[ProgramCpu, ...] = Field(
        default=(), description="while busy: those that take most, the largest first"
    )


class HostStatus(Message):
    """How a computer is, from its launcher, once a second."""

    host: str
    run: str = Field(description="the run's identity")
    plan_hash: str
    code: str = Field(description="commit of the code, with + where it was changed since")
    python: str
    uptime_s: NonNegative
    load_ratio: NonNegative = Field(description="of the last minute, over the number of cores")
    disk_free_bytes: int = Field(ge=0, description="where bags go, or in the working folder")
    memory_free_bytes: int = Field(ge=0)
    nodes: tuple[NodeProcess, ...]
    missing_devices: tuple[str, ...] = Field(description="what its nodes name and is not there")
    software: str = Field(default="", description="versions of what the hosts must agree about")
    keys: tuple[HostKey, ...] = Field(default=(), description="which hosts it lets in")
    estop: str | None = Field(default=None, description="reason of the e-stop that it keeps")
    cpu: CpuPressure | None = Field(
        default=None, description="None: its system does not measure it, or no node runs yet"
    )


PathJoin = Literal["rounded_lines", "spline"]


class FingerPath(Message):
    """A path for the twin's finger, from now on: it eases from where it is to the first point."""

    label: str
    times_s: Annotated[NDArray[np.float64], ArraySpec("<f8", ("points",))]
    positions_world_m: Annotated[NDArray[np.float64], ArraySpec("<f8", ("points", 3))]
    wander_m: NonNegative = Field(description="standard deviation of slow human error")
    tremor_m: NonNegative = Field(description="amplitude of 8-12 Hz tremor")
    joined_by: PathJoin = Field(
        default="rounded_lines",
        description="rounded_lines: the points are corners, rounded over +-40 ms; spline: they are "
        "samples of a smooth motion that begins and ends at rest",
    )
    stroke_s: Positive | None = Field(
        default=None, description="moving time, if the path is a stroke of the experiment"
    )


class TwinFinger(Message):
    """The true fingertip at the source stamp."""

    path_label: str
    path_done: bool
    path_time_s: Finite = Field(description="since the path began; negative while easing to it")
    path_stroke_s: Positive | None = Field(default=None, description="`stroke_s` of the path")
    position_world_m: Vector3
    velocity_world_m_per_s: Vector3


class TwinArms(Message):
    """True joint angles and flange poses of both arms at the source time stamp."""

    joints_left_rad: Vector6
    joints_right_rad: Vector6
    world_from_flange_left: Transform
    world_from_flange_right: Transform


class TwinEye(Message):
    """What a measuring camera at V sees of the projected image, and what it ought to see."""

    label: str
    correction: Correction
    metres_per_px: Positive = Field(description="of the picture, on the imaginary screen")
    seen: ColorImage
    expected: ColorImage
