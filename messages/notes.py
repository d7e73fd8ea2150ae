"""Define the notes that nodes publish in their status: a code, and a detail for people."""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum, StrEnum
from typing import TYPE_CHECKING

from pydantic import Field

from flexsheet.messages.base import MessagePart

if TYPE_CHECKING:
    from flexsheet.messages.types import FingertipReason, SelfCheck, SheetReason, SuspectedCause


class NoteCode(StrEnum):
    """The kind of a note. `REMEDIES` states what to do about each kind except INFO."""

    INFO = "info"
    WAITING_FOR_SCENE = "waiting-for-scene"
    ARM_DISCONNECTED = "arm-disconnected"
    ARM_ESTOP = "arm-estop"
    ARM_FAULT = "arm-fault"
    ARM_NOT_ENABLED = "arm-not-enabled"
    ARM_PATH_BLOCKED = "arm-path-blocked"
    ARM_WAITS = "arm-waits"
    CAMERA_SETTINGS = "camera-settings"
    COMMANDS_UNANSWERED = "commands-unanswered"
    FINGERTIPS_LATE = "fingertips-late"
    FINGER_PATH_REFUSED = "finger-path-refused"
    FORCE_NOT_POSSIBLE = "force-not-possible"
    FORCE_TABLE_MISSING = "force-table-missing"
    FRAME_NOT_RENDERED = "frame-not-rendered"
    FRAMES_MISSED = "frames-missed"
    HAND_CAN_OSCILLATE = "hand-can-oscillate"
    NO_IMAGES = "no-images"
    NO_PROJECTOR = "no-projector"
    NOT_RECORDING = "not-recording"
    OBJECT_TOO_SOFT = "object-too-soft"
    OSCILLATIONS_STOPPED = "oscillations-stopped"
    PAIRS_REJECTED = "pairs-rejected"
    SHEET_FOLDED = "sheet-folded"
    SHEET_PLANE_OLD = "sheet-plane-old"
    SHEET_SHAPE_INACCURATE = "sheet-shape-inaccurate"
    SHEET_SHAPES_MISSING = "sheet-shapes-missing"
    SOFT_BODY_COMPUTING = "soft-body-computing"
    SOFT_BODY_FAILED = "soft-body-failed"
    SOURCE_ENDED = "source-ended"
    STAMPED_ON_ARRIVAL = "stamped-on-arrival"
    TABLE_MISSING = "table-missing"
    WINDOW_CLOSED = "window-closed"
    WINDOW_LOST = "window-lost"
    WINDOW_SIZE = "window-size"


class Note(MessagePart):
    """A state or a problem of a node."""

    code: NoteCode = NoteCode.INFO
    detail: str = Field(default="", description="text for people, which programs do not evaluate")

    def __str__(self) -> str:
        if self.code is NoteCode.INFO:
            return self.detail
        return f"{self.code}: {self.detail}" if self.detail else self.code


def describe_notes(notes: Iterable[Note]) -> str:
    """Return the text of a node's notes, on one line."""
    return "; ".join(map(str, notes))


BUSY_FIRST = "First check whether the computer is busy: `flexsheet doctor`, row `load`. "
NO_ACTION = "No action is needed."


class NodeNote(Enum):
    """The problems and states that nodes report in their notes.

    phrase: constant part of the reported text.
    meaning: sentence that describes the problem.
    remedy: text that states what the user can do.
    """

    COMPUTER_BUSY = (
        "is busy:",
        "The processes of the graph wait too long for a processor.",
        "Nodes wait for a processor. End other programs, or give the graph more cores.",
    )
    TARGET_OR_ARM_LATE = (
        "the sheet target or the other arm is late",
        "The arm brakes because no new sheet target or state of the other arm arrives.",
        BUSY_FIRST + "Then check the network, and the rate of each topic: `flexsheet topic hz`.",
    )
    OTHER_ARM_SILENT = (
        "the other arm is silent",
        "The arm stops because the other arm's bridge sends no state.",
        BUSY_FIRST + "Then check the log of the other bridge, and the network.",
    )
    NO_SHEET_TARGET = (
        "no sheet target",
        "The arm stops because the planner sends no sheet target.",
        BUSY_FIRST + "Then check camera, triangulator and planner: `flexsheet topic hz`.",
    )
    PLANNER_ENDED = (
        "the connection to the planner has ended",
        "The arm stops because the process of the planner, or of a node before it, has ended.",
        "A node between camera and planner has ended and restarts. If the note remains, read its "
        "log: `flexsheet logs`.",
    )
    OTHER_BRIDGE_ENDED = (
        "the connection to the other arm's bridge has ended",
        "The arm stops because the process of the other arm's bridge has ended.",
        "The bridge has ended and restarts. If the note remains, read its log: `flexsheet logs`.",
    )
    ARM_WATCHDOG = (
        "the arm's watchdog stopped it",
        "The arm's controller stopped the arm because no command arrived in time.",
        BUSY_FIRST + "Then read the log of the arm's bridge, which sent no command for 100 ms.",
    )
    WAITING_FOR_ARM = (
        "waiting for the arm",
        "The bridge has no connection to the arm's controller yet.",
        "Wait for the arm's controller. If the note remains, check its power, address and cable.",
    )
    WAITING_FOR_OTHER_ARM = (
        "waiting for the other arm",
        "The bridge has received no state of the other arm yet.",
        "The other arm's bridge is starting. If the note remains, read its log: `flexsheet logs`.",
    )
    FOLLOWS_OTHER_ARM = (
        "waits for the other arm",
        "The arm is ready and starts to move together with the other arm.",
        "Both arms move together. `flexsheet arms status` shows what the other arm waits for.",
    )
    OTHER_ARM_NOT_READY = (
        "the other arm is not ready",
        "The arm does not move because the other arm is not enabled.",
        "Run `flexsheet arms enable`, which prints the reason if an arm is not ready.",
    )
    OTHER_ARM_FAULT = (
        "other arm:",
        "The arm has stopped because the other arm has a fault.",
        "Remove the cause at the other arm. Then run `flexsheet arms reset`.",
    )
    NOT_READY = (
        "not ready",
        "The arm is not enabled.",
        "Check that nobody is near the arms. Then run `flexsheet arms enable`.",
    )
    DISABLED = (
        "disabled",
        "An operator has disabled the arms.",
        "An operator has disabled the arms. Ask for the reason. Then run `flexsheet arms enable`.",
    )
    RESTARTING = (
        "restarts after a reset",
        "The bridge starts again after a reset.",
        "Wait a second. If the note remains, read the log of the bridge: `flexsheet logs`.",
    )
    ARM_STANDS_STILL = (
        "waits for the arm to stand still",
        "The bridge enables the arm only when the arm does not move.",
        "Wait until the arm rests. If the note remains, check that nothing moves it.",
    )
    CHECKING_PATH = (
        "checks the path to the target",
        "The bridges search for a path to the sheet without collision.",
        "Wait: the arms search for a path without collision, which takes a few seconds at most.",
    )
    MEASURED_VIOLATION = (
        "measured:",
        "The measured pose of the arm is outside a limit.",
        "The arm has left its limits. Move it back by hand. Then run `flexsheet arms reset`.",
    )
    COMMANDED_VIOLATION = (
        "commanded:",
        "A computed command was outside a limit.",
        "A command was outside a limit and was not sent. Run `flexsheet arms reset`, and report "
        "this error with a recording.",
    )
    SKEWED_EDGE = (
        "the edge is skewed by",
        "The two arms hold the edges of the sheet at different angles.",
        BUSY_FIRST
        + "Then check whether one arm has stopped or lags (`flexsheet arms status`), and "
        "whether the bases are calibrated (docs/set-up-arms.md). After a fault, run "
        "`flexsheet arms reset`.",
    )
    JOINT_RANGE = (
        "joint out of range",
        "The arm's controller refused a joint angle outside its range.",
        "The controller refused a joint angle. Compare its limits with `arms` of the scene.",
    )
    STEP_SIZE = (
        "step too large",
        "The arm's controller refused a command too far from the previous one.",
        "The controller refused a step. Compare its speed limits with `arms` of the scene.",
    )
    COMMAND_NOT_FINITE = (
        "command not finite",
        "The arm's controller received a command that contains NaN or infinity.",
        "The controller received an invalid number. Check the network, and report this error.",
    )
    CONTROLLER_WATCHDOG = (
        "watchdog: no command",
        "The program of the arm's controller stopped because no command arrived.",
        BUSY_FIRST + "Then read the log of the arm's bridge, and run `flexsheet arms reset`.",
    )
    SERVO_FAULT = (
        "servo fault",
        "The arm's controller has stopped the arm because of a fault of a servo.",
        "Read the fault at the controller and remove it. Then run `flexsheet arms reset`.",
    )
    STATUS_STALE = (
        "its joint angles are not used",
        "The arm's controller answers with old joint angles.",
        "The controller's program has stopped or restarts. Check the program. Then run "
        "`flexsheet arms reset`.",
    )
    NO_PATH = (
        "no path:",
        "The arms cannot reach the sheet from their present poses without a collision.",
        "Move the arms nearer to the sheet by hand, or move the sheet (docs/arms.md).",
    )
    NOT_RECORDING = (
        "NOT RECORDING:",
        "The recorder cannot write the bag.",
        "Free space on the disk, or record to another disk. The next bag starts automatically.",
    )
    NODE_HUNG = (
        "hung: no heartbeat",
        "A node has not responded within its time-out.",
        "The node is restarted. The end of its log (`flexsheet logs`) shows its stack. The key "
        "`liveness_s` of the launch file sets the time-out.",
    )
    KEY_REFUSED = (
        "rejects the key of this host; check its launch file",
        "Another host refused the connection because it does not know this host's key.",
        "The launch file of that host has no key or another key for this host. Copy the newest "
        "launch file to all hosts; `flexsheet doctor hosts` lists the differences.",
    )
    NO_KEYS_THERE = (
        "does not accept keys; its launch file may have none",
        "This host uses keys, but the other host uses none.",
        "Start all hosts with the same launch file, which must contain keys.",
    )
    KEY_NOT_PROVED = (
        "did not prove that it has its key",
        "The other host lacks the secret key that belongs to its key in the launch file.",
        "The secret key of that host does not match its public key in the launch file, or another "
        "program uses its address. `flexsheet doctor hosts` shows which host it is.",
    )
    READER_TOO_SLOW = (
        "a subscriber or the network is too slow",
        "A reader has lost messages because it did not read them in time.",
        "`flexsheet topic echo status` shows which port drops messages. Give that node more "
        "processor time, or the link more bandwidth.",
    )
    MAY_NOT_RESET = (
        "may not reset an e-stop",
        "The launch file does not permit this host to reset an e-stop.",
        "Reset it on a host for which the launch file sets `hosts.NAME.may_reset_estop`.",
    )
    CLOCK_NOT_MEASURED = (
        "is not measured",
        "The offset of another host's clock is not known yet.",
        "Wait a few seconds after a start. If the note remains, the clock node or the network of "
        "that host is down (docs/clocks.md).",
    )
    CLOCK_UNCERTAIN = (
        "ms are allowed",
        "The offset of another host's clock is known too inaccurately.",
        "Reduce the traffic of the network, set up chrony, or increase `max_offset_uncertainty_s` "
        "(docs/clocks.md).",
    )
    ESTOP_KEPT = (
        "latched until it is reset",
        "An e-stop is engaged and keeps the arms stopped.",
        "Run `flexsheet arms reset` when the danger is over.",
    )
    LAST_SHEET_PLANE = (
        "keeping the last valid sheet plane",
        "The renderer has no valid new pose of the sheet and uses the last one.",
        BUSY_FIRST + "The renderer or a bridge may lack processor time. Then check the arms' rate: "
        "`flexsheet topic hz arm_left`. The image recovers automatically.",
    )
    FRAMES_MISSED = (
        "frames missed",
        "The note states how many images the simulated camera has missed since its start.",
        "No action is needed unless the number grows steadily. " + BUSY_FIRST,
    )
    FAILED_EXCHANGES = (
        "failed exchanges",
        "The note states how many commands the arm has not answered since the bridge started.",
        "No action is needed unless the number grows steadily. "
        + BUSY_FIRST
        + "Then check the cable and the network of the arm.",
    )
    WAITING_FOR_SCENE = (
        "waits for the scene",
        "The node needs the scene, which the launcher publishes after the start.",
        "Wait a few seconds. If the note remains, read the log of the launcher: `flexsheet logs`.",
    )
    WAITING_FOR_TARGET = (
        "waiting for a sheet target",
        "The planner has not sent a sheet target since the bridge started.",
        "Wait until the finger is measured. If the note remains: `flexsheet topic hz fingertip`.",
    )
    ESTOP_ENGAGED = (
        "e-stop:",
        "An e-stop stops the arms. The text after it is the reason.",
        "Remove the reason. Then run `flexsheet arms reset`.",
    )
    SHEET_LENGTH = (
        "the measured length of the sheet is not possible",
        "The measured poses of the arms are farther apart than the sheet can be long.",
        "Check that the sheet is clamped, and calibrate the bases of the arms "
        "(docs/set-up-arms.md).",
    )
    JOINT_JUMP = (
        "the joint angles would jump by",
        "The next pose of the sheet needs other joint angles, so that the arm would jump.",
        "Move the arm by hand into the pose for the start. Then run `flexsheet arms reset`.",
    )
    LATE_FINGERTIPS = (
        "late fingertips dropped:",
        "The planner has ignored measured fingertips that were older than an earlier one.",
        "No action is needed unless the number grows steadily. " + BUSY_FIRST,
    )
    OSCILLATIONS_STOPPED = (
        "oscillations of finger and sheet stopped:",
        "Finger and sheet have oscillated against each other, and the planner has stopped this. "
        "The note counts these events since the start.",
        "No action is needed after a single one. If the number grows, reduce the delay or use a "
        "stiffer object (docs/hand-in-the-loop.md).",
    )
    FORCE_MODEL = (
        "sheet force model:",
        "The note names the model with which the planner computes the sheet's force.",
        NO_ACTION,
    )
    FORCE_TABLE_MISSING = (
        "the table of the sheet's force is missing",
        "A simpler, less accurate model of the sheet's force replaces the missing table.",
        "Run the command `flexsheet precompute` that the note states, and start the graph again.",
    )
    FORCE_MODEL_INVALID = (
        "is not valid here:",
        "The push is outside the range for which the model of the sheet's force was made.",
        "Reduce `working_range.push_depth_m` of the scene, or choose another "
        "`methods.sheet_force`.",
    )
    FORCE_NOT_RENDERED = (
        "than the sheet can render:",
        "The sheet cannot push as hard or as softly as the virtual object.",
        "Use another sheet or another object; `flexsheet doctor compliance SCENE` shows the "
        "errors.",
    )
    SOFTER_THAN_SHEET = (
        "is softer than the sheet",
        "The least stretched sheet is stiffer than the virtual object.",
        "Use a softer or wider sheet, or a stiffer object.",
    )
    STIFFER_THAN_SHEET = (
        "is stiffer than the sheet",
        "The most stretched sheet is softer than the virtual object.",
        "Use a stiffer sheet, or a softer object.",
    )
    TOO_SOFT_FOR_POSITION = (
        "is too soft for the position tolerance:",
        "An error of the sheet's position changes the force so much that a user notices it.",
        "Use a stiffer object, or reduce the error and `tolerances.sheet_position_m` of the scene.",
    )
    HAND_CAN_OSCILLATE = (
        "a hand of low damping can oscillate",
        "The sheet follows the finger so late that hand and sheet can oscillate.",
        "Reduce the delay or use a stiffer object (docs/hand-in-the-loop.md).",
    )
    RIGID_OBJECT = (
        "no soft body: the object is rigid",
        "The object of the scene has no material, so it does not deform.",
        NO_ACTION,
    )
    SOFT_BODY_FAILED = (
        "no soft body:",
        "The model of the soft object could not be computed.",
        "Correct what the note states, in the scene or on this computer. Then start the graph "
        "again.",
    )
    COMPUTING_SOFT_BODY = (
        "precomputing the soft body:",
        "The model of the soft object is computed once and then cached. The note states the "
        "progress, and the model with which the graph works until then.",
        "Continue if the graph works with another model until then; otherwise wait. `flexsheet "
        "precompute SCENE` does the same before a start.",
    )
    COMPUTING_TABLE = (
        "the nonlinear table is being computed",
        "The most accurate model of the soft object is computed in the background.",
        "Continue: a less accurate model computes the object until then.",
    )
    COMPUTATION_INTERRUPTED = (
        "precomputation interrupted",
        "A new scene has ended the computation of the soft object's model.",
        NO_ACTION,
    )
    TABLE_INTERRUPTED = (
        "the nonlinear table was interrupted",
        "The computation has ended early. Its finished parts are cached.",
        "Start the graph again, or run `flexsheet precompute SCENE`.",
    )
    TABLE_NOT_COMPUTED = (
        "the scene's nonlinear table is not computed yet",
        "A less accurate model computes the object, because the cache lacks the table.",
        "Run the command `flexsheet precompute` that the note states, and start the graph again.",
    )
    FRAMES_LOST = (
        "frames lost",
        "The note states how many images the camera has lost since its start.",
        "No action is needed unless the number grows steadily. " + BUSY_FIRST,
    )
    PAIRS_REJECTED = (
        "pairs rejected:",
        "The exposures of both cameras are farther apart in time than `max_skew_s` allows.",
        "Synchronise both cameras with a trigger, or increase `max_skew_s` (docs/camera.md).",
    )
    UNPAIRED_FRAMES = (
        "frames without a partner",
        "One of the two cameras has delivered images to which the other has none.",
        "No action is needed unless the number grows steadily. Then check cables and trigger.",
    )
    NO_IMAGES = (
        "no images:",
        "The camera node cannot read its source, and tries again.",
        "Correct what the note states: cable, device or file of the node's parameter `source`.",
    )
    SOURCE_ENDED = (
        "pairs read, and the source has ended",
        "The video or the image files of the camera node have ended.",
        "Start the graph again, or set `loop` of the parameter `source`.",
    )
    STAMPED_BY_DRIVER = (
        "stamped by the driver",
        "The camera's driver states the time of each image.",
        NO_ACTION,
    )
    STAMPED_ON_ARRIVAL = (
        "stamped on arrival",
        "The driver states no plausible times, so that images have the time of their arrival.",
        "Measure the delay (docs/camera.md), because the latency of the camera is not known.",
    )
    MEASURED_RATE = (
        "Hz measured",
        "The note states the rate at which the camera delivers images.",
        "Compare the rate with `camera.rate_hz` of the scene.",
    )
    FILE_TIMES = (
        "frame times of the",
        "The times of the images are those of the file.",
        NO_ACTION,
    )
    SET_RATE = (
        "at the set rate",
        "The images of the file are played at the rate of the parameter `source`.",
        NO_ACTION,
    )
    CROPPED = (
        "regions cropped from",
        "The camera node cuts the regions of its parameter `region` out of the images.",
        NO_ACTION,
    )
    IMAGE_RESULTS = (
        "image pairs dropped as late:",
        "The note counts the results of the marker detection: `ok` and reasons for no marker.",
        "`flexsheet explain REASON` explains each reason. Late pairs: " + BUSY_FIRST,
    )
    EYES_OF_SCENE = (
        "the eyes of the scene are used",
        "The image is drawn for the eyes of the scene file instead of the measured eyes.",
        "Check the node that measures the eyes: `flexsheet topic echo eye`.",
    )
    CLOCK_OFFSETS = (
        "clock offset of",
        "The note states by how much the clocks of other hosts differ, and the uncertainty.",
        NO_ACTION,
    )
    CONSOLE_PAGE = (
        "viewers:",
        "The note states the address of the console's page, and how many browsers show it.",
        "Open the address in a browser.",
    )
    RECORDER_WAITS = (
        "waits for a request to record",
        "The recorder records when the console requests it.",
        "Press the button of the console to record.",
    )
    RECORDING = (
        "recording:",
        "The note states how many messages are in the bag, and its file.",
        NO_ACTION,
    )
    RECORDED = (
        "recorded:",
        "The note states how many messages are in the finished bag, and its file.",
        NO_ACTION,
    )
    NO_PROJECTOR = (
        "no image: the scene has no projector",
        "The scene has no key `projector`, so that no image is drawn.",
        "Add `projector` to the scene if an image is wanted.",
    )
    WINDOW_CLOSED = (
        "the window was closed",
        "The user has closed the window of the projector's image.",
        "Restart the graph or the node to show the image again.",
    )
    WINDOW_LOST = (
        "the window was lost",
        "The display has closed the window of the projector's image, which opens again.",
        "Check the cable of the projector and the settings of the desktop.",
    )
    WINDOW_SIZE = (
        "images are shown unscaled in the centre",
        "The window and the images of the projector have different sizes in pixels.",
        "Set the same size on the monitor and in `projector` of the scene.",
    )
    NO_DEFLECTION_SHAPES = (
        "the cache contains no deflection shapes",
        "The shape of the pushed sheet is drawn roughly, because a table is missing.",
        "Run the command `flexsheet precompute` that the note states, and restart the graph.",
    )
    SHEET_FOLDED = (
        "of the sheet is folded and gets no light",
        "The pushed sheet hides a part of itself from the projector.",
        "Push less deeply, or tilt the projector less relative to the sheet.",
    )
    DEEP_FOR_TRIANGLES = (
        "exceeds the maximum for four triangles",
        "The method that draws the sheet as four triangles is inaccurate for this push.",
        "Set `methods.sheet_shape` of the scene to `reduced_order`.",
    )
    ARM_COMMANDS = (
        "commands, refused:",
        "The note counts the commands that each simulated arm has received and refused.",
        "No action is needed unless the refused commands grow. Then read the bridge's note.",
    )
    FRAME_RENDERED = (
        "rendered the frame",
        "The note names the last image that was computed for an eye of the user.",
        NO_ACTION,
    )
    FRAME_NOT_RENDERED = (
        "cannot be rendered",
        "The view of the eye cannot be computed for images that contain two views.",
        "Set `stereo` of the topic `display` to `mono`.",
    )
    FOLLOWS_PATH = (
        "follows the path",
        "The simulated finger moves along the path that the note names, or has ended it.",
        NO_ACTION,
    )
    COMPUTING_SHEET_REACTION = (
        "the force of the sheet on the finger is being computed",
        "The table of the sheet's force on the simulated finger is computed once.",
        "Wait: the finger follows paths when the computation has finished.",
    )
    FINGER_PATH_REFUSED = (
        "refused finger path",
        "The simulated finger cannot follow a path of the topic `twin/finger_path`, and continues "
        "its present motion.",
        "Correct the path as the note states, and publish it again: `flexsheet topic pub`.",
    )
    FORCE_ERROR = (
        "force error up to",
        "The note states the relative force error that the method of the soft body is known to "
        "have at two depths of a push.",
        "The node runs. If the error exceeds `tolerances.force_ratio` of the scene, let "
        "`flexsheet tune` choose `methods.soft_body`.",
    )

    def __init__(self, phrase: str, meaning: str, remedy: str) -> None:
        self.phrase = phrase
        self.meaning = meaning
        self.remedy = remedy

    @property
    def code(self) -> str:
        """Return the name of the problem for the command `flexsheet explain`."""
        return self.name.lower().replace("_", "-")


SHEET_REASON_TEXTS: dict[SheetReason, str] = {
    "ok": "",
    "fingertip_invalid": "the fingertip is not tracked",
    "fingertip_not_finite": "the fingertip's position is not finite",
    "fingertip_too_old": "the measured fingertip is too old",
    "fingertip_in_future": "the fingertip's timestamp is in the future",
    "implausible_input": "the finger is too far away or too fast",
    "ambiguous_side": "the finger is inside the object, and its side is unclear",
    "through_object": "the finger has passed through the object",
    "past_object_edge": "the finger is past the object's edge",
    "beyond_tilt": "the finger is beyond the tilt of the sheet",
    "beyond_spin": "the sheet has rotated too far about its normal; lift the finger",
    "past_sheet_width": "the finger is past the sheet's usable width",
    "past_sheet_height": "the finger is past the sheet's usable height",
    "concave_contact": "the object is concave there, and the flat sheet touches its rim",
}
"""The texts that the console displays for each `reason` in the topic `sheet_target`."""

SHEET_REASON_REMEDIES: dict[SheetReason, str] = {
    "fingertip_invalid": "`flexsheet topic echo fingertip --field reason` prints the reason.",
    "fingertip_not_finite": "Report this error of the triangulator, with a recording.",
    "fingertip_too_old": BUSY_FIRST + "Then check camera and triangulator: `flexsheet status`.",
    "fingertip_in_future": "Check the clocks of the hosts: `flexsheet doctor hosts`.",
    "implausible_input": "Move the finger slowly into the working range, and cover reflections.",
    "ambiguous_side": "Lift the finger out of the object, and approach it from one side.",
    "through_object": "Lift the finger, and approach the object from the front again.",
    "past_object_edge": "Move the finger back to the object's surface.",
    "beyond_tilt": "Move the finger back, or allow more tilt: `working_range` of the scene.",
    "beyond_spin": "Lift the finger and touch the object again.",
    "past_sheet_width": "Move the finger towards the middle of the sheet.",
    "past_sheet_height": "Move the finger towards the middle of the sheet.",
    "concave_contact": "Touch the object beside the hollow: a flat sheet cannot enter it.",
}
"""The remedy for each `reason` in the topic `sheet_target`, except "ok"."""


FINGERTIP_REASON_TEXTS: dict[FingertipReason, str] = {
    "no_marker": "no marker was found",
    "marker_in_one_view": "only one camera sees the marker",
    "two_markers": "there are several possible markers",
    "merged": "the marker's image touches another bright spot",
    "blurred": "the marker moves too fast for the exposure",
    "saturated": "the marker is overexposed",
    "outside_volume": "the marker is outside the finger's possible positions",
    "inconsistent": "the rays of the two cameras do not intersect",
    "too_fast": "the marker is faster than a finger",
    "unconfirmed": "there are too few detections for a track",
}
"""The meaning of each `reason` in the topic `fingertip`, except "ok"."""

FINGERTIP_REMEDIES: dict[FingertipReason, str] = {
    "no_marker": "Move the finger into view, replace a lost marker, or use a longer exposure.",
    "marker_in_one_view": "One camera does not see the marker: move the finger or the camera.",
    "two_markers": "Cover reflections, and use one marked finger only.",
    "merged": "Remove the bright spot that touches the marker's image.",
    "blurred": "The finger is too fast: use a shorter exposure and more light.",
    "saturated": "The marker is overexposed: use a shorter exposure.",
    "outside_volume": "Move the finger into the working range of the scene.",
    "inconsistent": "The rays of both views do not intersect: calibrate the camera again.",
    "too_fast": "A jump faster than a finger is usually a reflection: cover it.",
    "unconfirmed": "Wait: a new marker is accepted after a few images.",
}
"""The remedy for each `reason` in the topic `fingertip`, except "ok"."""

SELF_CHECK_FINDINGS: dict[SuspectedCause, str] = {
    "camera_moved": "the stereo camera is not where the scene says",
    "cameras_misaligned": "one of the two cameras has moved relative to the other",
    "marker_offset": "the finger's marker is not at its assumed position",
    "servo_lag": "the lag of the arm differs from the configured lag",
    "sheet_stiffness": "the sheet is not as stiff as the scene states",
    "arm_not_following": "the arm does not execute the commanded motion",
    "projector_moved": "the projector's pose or lens differs from the scene",
    "arm_base_moved": "the sheet is not where the arms' poses say: a base or a clamp has moved",
    "camera_or_projector_moved": "the stereo camera or the projector is not where the scene says",
    "camera_or_arm_base_moved": "the stereo camera or the base of an arm is not where the scene "
    "says",
    "display_latency": "projected images appear later than assumed",
}
"""The description of each suspected cause of a deviation from expected values."""

SELF_CHECK_REMEDIES: dict[SuspectedCause, str] = {
    "camera_moved": "Fasten the camera, and calibrate its pose again (docs/set-up-camera.md).",
    "cameras_misaligned": "Fasten both cameras and lenses, and run `flexsheet calibrate stereo`.",
    "marker_offset": "Put the marker back where it was, or calibrate its offset again.",
    "servo_lag": BUSY_FIRST + "An overloaded computer is the usual cause with simulated arms. For "
    "a real arm, check its payload and its controller's filters. The bridge uses the measured "
    "lag. Its parameter `servo_lag_s` sets the expected lag.",
    "sheet_stiffness": "Set `sheet.young_modulus_pa` of the scene to the calibrated stiffness "
    "(N/m) divided by the thickness, or calibrate the sheet again.",
    "arm_not_following": "Check the arm for a collision, its load, and the backlash of its gears.",
    "projector_moved": "Fasten the projector, and run `flexsheet calibrate projector`.",
    "arm_base_moved": "Check the clamps, and calibrate the bases of the arms again "
    "(docs/set-up-arms.md).",
    "camera_or_projector_moved": "Set `reference_marks_world_m` of the triangulator to find out "
    "which has moved, or calibrate both again.",
    "camera_or_arm_base_moved": "Set `reference_marks_world_m` of the triangulator to find out "
    "which has moved, or calibrate both again.",
    "display_latency": "Set `display_latency_s` of the renderer to the measured latency.",
}
"""The remedy for each suspected cause of a deviation from expected values."""

_SHOWN_UNITS = {
    "m": ("mm", 1e3),
    "s": ("ms", 1e3),
    "px": ("px", 1.0),
    "rad": ("mrad", 1e3),
    "N/m": ("N/m", 1.0),
}


def describe_self_check(check: SelfCheck) -> str:
    """Describe the suspected cause of a deviation, with the measured and the expected value."""
    unit, scale = _SHOWN_UNITS[check.unit]
    subject = f"{check.subject}: " if check.subject else ""
    return (
        f"{subject}{SELF_CHECK_FINDINGS[check.cause]} (measured {check.value * scale:.2f} {unit}, "
        f"expected {check.expected * scale:.2f} ± {check.threshold * scale:.2f} {unit})"
    )
