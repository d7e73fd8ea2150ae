"""Define the remedies for notes of nodes, which `flexsheet explain` prints."""

from __future__ import annotations

from enum import Enum

from flexsheet.messages.types import FingertipReason, SelfCheck, SuspectedCause

BUSY_FIRST = "First check whether the computer is busy: `flexsheet doctor`, row `load`. "


class NodeNote(Enum):
    """Notes, reasons and warnings of nodes that need an action, by the constant text in them."""

    COMPUTER_BUSY = (
        "is busy:",
        "Nodes wait for a processor. End other programs, or give the graph more cores.",
    )
    TARGET_OR_ARM_LATE = (
        "sheet target or other arm late",
        BUSY_FIRST + "Then check the network, and the rate of each topic: `flexsheet topic hz`.",
    )
    OTHER_ARM_SILENT = (
        "the other arm is silent",
        BUSY_FIRST + "Then check the log of the other bridge, and the network.",
    )
    NO_SHEET_TARGET = (
        "no sheet target",
        BUSY_FIRST + "Then check camera, triangulator and planner: `flexsheet topic hz`.",
    )
    ARM_WATCHDOG = (
        "the arm's watchdog stopped it",
        BUSY_FIRST + "Then read the log of the arm's bridge, which sent no command for 100 ms.",
    )
    NO_PATH = (
        "no path:",
        "Move the arms nearer to the sheet by hand, or move the sheet (docs/arms.md).",
    )
    NOT_RECORDING = (
        "NOT RECORDING:",
        "Free space on the disk, or record to another one. Then the next bag starts automatically.",
    )
    NODE_HUNG = (
        "hung: no heartbeat",
        "The node is restarted. The end of `logs/NODE.log` of the run shows its stack. "
        "`liveness_s` of the launch file sets the time-out.",
    )
    KEY_REFUSED = (
        "rejects the key of this host",
        "The launch file of that host has no key or another key for this host. Copy the newest "
        "launch file to all hosts; `flexsheet doctor hosts` lists the differences.",
    )
    NO_KEYS_THERE = (
        "does not accept keys",
        "Start that host with a launch file that has keys, the same on all hosts.",
    )
    KEY_NOT_PROVED = (
        "did not prove that it has its key",
        "The secret key of that host does not match its public key in the launch file, or another "
        "program uses its address: `flexsheet doctor hosts`.",
    )
    READER_TOO_SLOW = (
        "a subscriber or the network is too slow",
        "`flexsheet topic echo status` shows which port drops messages. Give that node more "
        "processor time, or the link more bandwidth.",
    )
    MAY_NOT_RESET = (
        "may not reset an e-stop",
        "Reset it on a host for which the launch file sets `hosts.NAME.may_reset_estop`.",
    )
    CLOCK_NOT_MEASURED = (
        "is not measured",
        "Wait some seconds after a start. If the note remains, the clock node or the network of "
        "that host is down (docs/clocks.md).",
    )
    CLOCK_UNCERTAIN = (
        "ms are allowed",
        "Reduce the traffic of the network, set up chrony, or allow more (docs/clocks.md).",
    )
    ESTOP_KEPT = (
        "latched until it is reset",
        "Reset it when the danger is over: `flexsheet arms reset`.",
    )
    LAST_SHEET_PLANE = (
        "keeping the last valid sheet plane",
        "The arms are silent, or the sheet faces away. The renderer recovers automatically.",
    )

    def __init__(self, phrase: str, remedy: str) -> None:
        self.phrase = phrase
        self.remedy = remedy

    @property
    def code(self) -> str:
        """Return the name for `flexsheet explain`."""
        return self.name.lower().replace("_", "-")


FINGERTIP_REMEDIES: dict[FingertipReason, str] = {
    "no_marker": "Move the finger into the view, replace a lost marker, or expose longer.",
    "marker_in_one_view": "One camera does not see the marker: move the finger or the camera.",
    "two_markers": "Cover reflections, and use one marked finger only.",
    "merged": "Remove the bright spot that touches the marker's image.",
    "blurred": "The finger is too fast for the exposure: expose shorter, with more light.",
    "saturated": "The marker is overexposed: expose shorter.",
    "outside_volume": "Move the finger into the working range of the scene.",
    "inconsistent": "The rays of both views do not meet: calibrate the camera again.",
    "too_fast": "A jump faster than a finger is usually a reflection: cover it.",
    "unconfirmed": "Wait: a new marker is accepted after a few images.",
}
"""Remedies by `reason` of the topic `fingertip`, except "ok"."""

SELF_CHECK_FINDINGS: dict[SuspectedCause, str] = {
    "camera_moved": "the stereo camera is not where the scene says",
    "cameras_misaligned": "one of the two cameras has moved against the other",
    "marker_offset": "the finger's marker is not at its assumed position",
    "servo_lag": "the lag of the arm differs from the configured one",
    "sheet_stiffness": "the sheet is not as stiff as the scene states",
    "arm_not_following": "the arm does not do the commanded motion",
}
"""Findings by the cause that a self-check suspects."""

SELF_CHECK_REMEDIES: dict[SuspectedCause, str] = {
    "camera_moved": "Fasten the camera, and calibrate its pose again (docs/set-up-camera.md).",
    "cameras_misaligned": "Fasten both cameras and lenses, and run `flexsheet calibrate stereo`.",
    "marker_offset": "Put the marker back where it was, or calibrate its offset again.",
    "servo_lag": "The measured lag is used. Check the payload and filters of the arm, or set "
    "`servo_lag_s` of its bridge to the measured lag.",
    "sheet_stiffness": "Set `sheet.young_modulus_pa` of the scene to the calibrated value over the "
    "thickness, or calibrate the sheet again.",
    "arm_not_following": "Check the arm for a collision, its load, and the backlash of its gears.",
}
"""Remedies by the cause that a self-check suspects."""

_SHOWN_UNITS = {
    "m": ("mm", 1e3),
    "s": ("ms", 1e3),
    "px": ("px", 1.0),
    "rad": ("mrad", 1e3),
    "N/m": ("N/m", 1.0),
}


def describe_self_check(check: SelfCheck) -> str:
    """Return a suspicion with its numbers, for people."""
    unit, scale = _SHOWN_UNITS[check.unit]
    subject = f"{check.subject}: " if check.subject else ""
    return (
        f"{subject}{SELF_CHECK_FINDINGS[check.cause]} (measured {check.value * scale:.2f} {unit}, "
        f"expected {check.expected * scale:.2f} ± {check.threshold * scale:.2f} {unit})"
    )
