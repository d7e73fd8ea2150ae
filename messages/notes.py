"""Define the notes that nodes publish in their status: a code, and a detail for people."""

from __future__ import annotations

from enum import StrEnum
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


BUSY_FIRST = "First check whether the computer is busy: `flexsheet doctor`, row `load`. "
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
