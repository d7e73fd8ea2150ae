"""Define the notes that nodes publish in their status: a code, and a detail for people."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING

from pydantic import Field

from flexsheet.messages.base import MessagePart

if TYPE_CHECKING:
    from flexsheet.messages.types import FingertipReason, SelfCheck, SheetReason, SuspectedCause


class NoteCode(StrEnum):
    """The kind of a note. `NOTE_REMEDIES` states what to do about each kind except INFO."""

    INFO = "info"
    WAITING_FOR_SCENE = "waiting-for-scene"
    ARM_BLOCKED = "arm-blocked"
    ARM_ESTOP = "arm-estop"
    ARM_FAULT = "arm-fault"
    ARM_NOT_READY = "arm-not-ready"
    ARM_SILENT = "arm-silent"
    ARM_WAITS = "arm-waits"
    CAMERA_SETTINGS = "camera-settings"
    COMMANDS_UNANSWERED = "commands-unanswered"
    EYES_OF_SCENE = "eyes-of-scene"
    FINGER_PATH_REFUSED = "finger-path-refused"
    FINGERTIPS_LATE = "fingertips-late"
    FORCE_LIMITED = "force-limited"
    FRAME_NOT_RENDERED = "frame-not-rendered"
    FRAMES_MISSED = "frames-missed"
    NO_IMAGES = "no-images"
    NO_PROJECTOR = "no-projector"
    NOT_RECORDING = "not-recording"
    OSCILLATIONS_STOPPED = "oscillations-stopped"
    PAIRS_REJECTED = "pairs-rejected"
    SHEET_POSE_OLD = "sheet-pose-old"
    SHEET_SHAPE_INACCURATE = "sheet-shape-inaccurate"
    SOFT_BODY_COMPUTING = "soft-body-computing"
    SOFT_BODY_FAILED = "soft-body-failed"
    SOFT_BODY_TABLE_MISSING = "soft-body-table-missing"
    SOURCE_ENDED = "source-ended"
    WINDOW = "window"


class Note(MessagePart):
    """A state or a problem of a node."""

    code: NoteCode = NoteCode.INFO
    detail: str = Field(default="", description="text for people, which programs do not evaluate")

    def __str__(self) -> str:
        parts = (self.code if self.code is not NoteCode.INFO else "", self.detail)
        return ": ".join(filter(None, parts))


BUSY_FIRST = "First check whether the computer is busy: `flexsheet doctor`, row `load`. "
IF_IT_GROWS = "If the number grows steadily, check row `load` of `flexsheet doctor`."

NOTE_REMEDIES: dict[NoteCode, str] = {
    NoteCode.WAITING_FOR_SCENE: "Wait a few seconds. If it remains, read `flexsheet logs`.",
    NoteCode.ARM_BLOCKED: "Move the arms nearer to the sheet by hand, or move the sheet.",
    NoteCode.ARM_ESTOP: "Remove the reason of the e-stop. Then run `flexsheet arms reset`.",
    NoteCode.ARM_FAULT: "Remove the cause that is named. Then run `flexsheet arms reset`.",
    NoteCode.ARM_NOT_READY: "Check that nobody is near the arms. Then run `flexsheet arms enable`.",
    NoteCode.ARM_SILENT: "Check power, address and cable of the arm's controller, and its program.",
    NoteCode.ARM_WAITS: BUSY_FIRST + "Then compare rates: `flexsheet topic hz sheet_target`.",
    NoteCode.CAMERA_SETTINGS: "Choose settings in the scene that the camera supports.",
    NoteCode.COMMANDS_UNANSWERED: BUSY_FIRST + "Then check the cable and the network of the arm.",
    NoteCode.EYES_OF_SCENE: "Check the program that measures the eyes: `flexsheet topic echo eye`.",
    NoteCode.FINGER_PATH_REFUSED: "Correct the path, and publish it again: `flexsheet topic pub`.",
    NoteCode.FINGERTIPS_LATE: IF_IT_GROWS,
    NoteCode.FORCE_LIMITED: "Choose another object or sheet: docs/hand-in-the-loop.md.",
    NoteCode.FRAME_NOT_RENDERED: "Set `stereo` of the topic `display` to `mono`.",
    NoteCode.FRAMES_MISSED: IF_IT_GROWS,
    NoteCode.NO_IMAGES: "Correct the cable, the device, or the file of the parameter `source`.",
    NoteCode.NO_PROJECTOR: "Add `projector` to the scene if an image is wanted.",
    NoteCode.NOT_RECORDING: "Free space on the disk; the next bag then starts automatically.",
    NoteCode.OSCILLATIONS_STOPPED: "If they recur, reduce the delay or use a stiffer object.",
    NoteCode.PAIRS_REJECTED: "Synchronise the cameras by a trigger, or increase `max_skew_s`.",
    NoteCode.SHEET_POSE_OLD: BUSY_FIRST + "The image recovers automatically.",
    NoteCode.SHEET_SHAPE_INACCURATE: "Run the command that is named, or push less deeply.",
    NoteCode.SOFT_BODY_COMPUTING: "Wait, or run `flexsheet precompute SCENE` before the start.",
    NoteCode.SOFT_BODY_FAILED: "Correct the named cause, and start the graph again.",
    NoteCode.SOFT_BODY_TABLE_MISSING: "Stop the graph, and run the command that is named.",
    NoteCode.SOURCE_ENDED: "Start the graph again, or set `loop` of the parameter `source`.",
    NoteCode.WINDOW: "Set the size of the projector's mode in the scene; check its cable.",
}
"""The remedy for each kind of note. The documentation contains this table."""

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
