"""Render the banner of the console page: the state of the arms, and what the user must do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from html import escape

from flexsheet.messages.notes import SHEET_REASON_TEXTS
from flexsheet.messages.types import ArmMode, ArmState, SheetTarget
from flexsheet.nodes.console.panels import MODES, make_paragraph


class BannerState(IntEnum):
    """The states that the banner shows.

    If several states apply, the state with the largest value has priority.
    """

    READY = 0
    WAITING = 1
    FAULT = 2
    ESTOP = 3


GROUNDS = {
    BannerState.READY: "good",
    BannerState.WAITING: "quiet",
    BannerState.FAULT: "bad",
    BannerState.ESTOP: "bad",
}
"""The suffix of the CSS class in page.css that sets the banner's background in each state."""

FAULTY_MODES: tuple[ArmMode, ...] = ("fault", "estop", "disconnected")
STILL_STOPPED = "the arms are still stopped"


@dataclass(frozen=True, slots=True)
class GraphState:
    """The state of the running graph that the banner describes.

    scene: name of the scene.
    arms: states of the arms by side.
    estop_reason: reason of the engaged e-stop; None if no e-stop is engaged.
    sheet: newest sheet target; None before the first target.
    overload: sentence about an overloaded computer; empty if no computer is overloaded.
    solver_note: note of the soft-body solver; empty if the solver has a result for the scene.
    """

    scene: str
    arms: Mapping[str, ArmState] = field(default_factory=dict)
    estop_reason: str | None = None
    sheet: SheetTarget | None = None
    overload: str = ""
    solver_note: str = ""

    @property
    def stopped(self) -> str | None:
        """Return the reason of the engaged e-stop, or None if no e-stop is engaged."""
        if self.estop_reason is None and any(arm.mode == "estop" for arm in self.arms.values()):
            return STILL_STOPPED
        return self.estop_reason

    @property
    def banner(self) -> BannerState:
        """Return the state to show: the applicable state with the highest priority."""
        if self.stopped is not None:
            return BannerState.ESTOP
        if any(map(is_faulty, self.arms.values())):
            return BannerState.FAULT
        if self.arms and all(arm.mode == "follow" for arm in self.arms.values()):
            return BannerState.READY
        return BannerState.WAITING

    @property
    def resettable(self) -> bool:
        """Return whether an e-stop or a fault can be reset."""
        return self.stopped is not None or any(arm.faults for arm in self.arms.values())


def is_faulty(arm: ArmState) -> bool:
    """Return whether an arm does not follow the finger because of a fault or a blocked path."""
    return bool(arm.faults) or arm.mode in FAULTY_MODES or arm.path_blocked


def render(state: GraphState) -> str:
    """Return the banner and the explanation below it as HTML."""
    shown = state.banner
    sentences = [state.overload, _remedy(state, shown), _explain(state, shown)]
    forces = [arm.edge_force_n for arm in state.arms.values() if arm.edge_force_n is not None]
    if forces:
        sentences.append(f"The edge force is {max(forces):.1f} N.")
    if state.solver_note:
        sentences.append(f"The object is not shown yet. Its solver reports: {state.solver_note}.")
    scene = f"Scene <b>{escape(state.scene)}</b>."
    text = " ".join([scene, *(escape(one) for one in sentences if one)])
    return (
        '<div class="fs-state" tabindex="0" role="group" aria-label="State of the arms">'
        f'<div role="status" aria-live="polite" data-state="{shown.name.lower()}" '
        f'class="fs-banner fs-ground-{GROUNDS[shown]}">{escape(_title(state, shown))}</div>'
        f"{make_paragraph(text)}</div>"
    )


def _title(state: GraphState, shown: BannerState) -> str:
    match shown:
        case BannerState.ESTOP:
            return f"E-STOP is engaged: {state.stopped}"
        case BannerState.FAULT:
            return "; ".join(_describe(side, arm) for side, arm in state.arms.items())
        case _ if state.arms:
            modes = sorted({MODES[arm.mode] for arm in state.arms.values()})
            return f"Arms: {' / '.join(modes)}"
        case _:
            return "Waiting for the arms"


def _describe(side: str, arm: ArmState) -> str:
    if arm.path_blocked and not arm.faults:
        return f"{side} arm: its path is blocked ({arm.reason})"
    faults = f" ({', '.join(arm.faults)})" if arm.faults else ""
    return f"{side} arm: {MODES[arm.mode]}{faults}"


def _remedy(state: GraphState, shown: BannerState) -> str:
    """Return a sentence about the action that the user must take; empty if there is none."""
    arms = state.arms.values()
    if shown is BannerState.ESTOP:
        return f"Release the stop when the arms are at rest; {_after_reset(state)}."
    if shown is BannerState.FAULT:
        if any(arm.path_blocked and not arm.faults for arm in arms):
            return (
                "Lower Tension or Size, choose another scene, or move the finger. "
                "The arms then search for a path again."
            )
        if all(arm.mode == "disconnected" for arm in arms if is_faulty(arm)):
            return "Check the power and the cable of the arm. The arm reconnects automatically."
        return f"Remove the cause, then press Reset the fault; {_after_reset(state)}."
    if shown is BannerState.WAITING and any(not arm.ready and not arm.auto_arming for arm in arms):
        return "The arms stay at rest until you run: flexsheet arms enable."
    return ""


def _after_reset(state: GraphState) -> str:
    if state.arms and all(arm.auto_arming for arm in state.arms.values()):
        return "the arms then move immediately"
    return "the arms then stay at rest until you run: flexsheet arms enable"


def _explain(state: GraphState, shown: BannerState) -> str:
    """Return the reason why an arm does not follow the finger, or describe the sheet's state.

    Arms with faults are ignored here. If all other arms follow the finger, the result is a sentence
    about the sheet.
    """
    if shown is BannerState.ESTOP:
        return ""
    for side, arm in state.arms.items():
        if arm.mode != "follow" and not is_faulty(arm) and arm.reason:
            return f"The {side} arm reports: {arm.reason}."
    sheet = state.sheet
    if sheet is None or not state.arms:
        return ""
    match sheet.phase:
        case "contact":
            return f"The finger pushes {1e3 * sheet.push_depth_m:.1f} mm deep."
        case "approach":
            return "The sheet waits in front of the finger."
        case _:
            text = SHEET_REASON_TEXTS[sheet.reason]
            return f"The sheet holds its pose: {text}." if text else "The sheet holds its pose."
