"""Test the arm control's transition table: complete, and no motion without arming."""

from __future__ import annotations

import ast
from collections.abc import Collection
from itertools import product
from pathlib import Path

import pytest

from flexsheet.nodes.arm_bridge import control
from flexsheet.nodes.arm_bridge.control import ArmControl, Timeouts
from flexsheet.nodes.arm_bridge.state_machine import (
    MODES,
    MOTION_STATES,
    READY_STATES,
    TRANSITIONS,
    Event,
    State,
)

STOPS = (Event.FAULT, Event.ESTOP, Event.ISOLATED, Event.INTERLOCK, Event.WATCHDOG_TRIPPED)
STOPPING = {State.STOPPING, State.STOPPING_TAUT}


def apply(state: State, event: Event) -> State:
    return TRANSITIONS[state, event] or state


def reachable(starts: Collection[State], events: Collection[Event]) -> set[State]:
    """Return every state that a sequence of the events leads to."""
    found, open_states = set(starts), list(starts)
    while open_states:
        state = open_states.pop()
        for after in {apply(state, event) for event in events} - found:
            found.add(after)
            open_states.append(after)
    return found


def test_every_pair_of_state_and_event_is_in_the_table() -> None:
    assert set(TRANSITIONS) == set(product(State, Event))
    assert set(MODES) == set(State)
    for (state, event), target in TRANSITIONS.items():
        assert target is not state or event is Event.CONNECTION_LOST, (state, event)


def test_every_state_can_be_reached_and_every_event_acts_somewhere() -> None:
    assert reachable({State.STARTING}, list(Event)) == set(State)
    assert {event for (_, event), target in TRANSITIONS.items() if target} == set(Event)


def test_without_arming_no_sequence_of_events_leads_to_motion() -> None:
    events = set(Event) - {Event.ARM}
    found = reachable({State.STARTING}, events)
    assert not found & MOTION_STATES
    assert not found & READY_STATES


@pytest.mark.parametrize("stop", [Event.CONNECTION_LOST, Event.ESTOP, Event.ISOLATED])
def test_after_a_stop_that_forbids_relaxing_only_arming_leads_to_motion(stop: Event) -> None:
    events = set(Event) - {Event.ARM}
    for state in State:
        after = reachable({apply(state, stop)}, events)
        assert not after & (MOTION_STATES - {State.STOPPING}), state


@pytest.mark.parametrize("stop", STOPS)
def test_a_stop_leads_from_every_moving_state_to_stopping_and_disarms(stop: Event) -> None:
    for state in MOTION_STATES - {State.RELAX}:
        assert apply(state, stop) in STOPPING, state
    for state in State:
        assert apply(state, stop) not in READY_STATES, state
    # Slackening the sheet is the reaction to a fault, so only a stop that forbids it ends it.
    keeps_relaxing = stop in (Event.FAULT, Event.INTERLOCK)
    assert apply(State.RELAX, stop) is (State.RELAX if keeps_relaxing else State.STOPPING)


def test_a_stopped_arm_comes_to_rest_whatever_else_happens_but_arming() -> None:
    assert apply(State.STOPPING, Event.AT_REST) not in MOTION_STATES
    assert apply(State.STOPPING_TAUT, Event.AT_REST) not in MOTION_STATES
    for state in STOPPING:
        after = {apply(state, event) for event in set(Event) - {Event.ARM}}
        assert not after & (MOTION_STATES - STOPPING)


def test_motion_towards_a_target_begins_only_after_a_path_check() -> None:
    events = set(Event) - {Event.PATH_CLEAR}
    found = reachable({State.STARTING}, events)
    assert not found & {State.FOLLOW, State.HOLD, State.RELAX}


def test_a_latched_stop_is_left_only_by_a_reset_or_a_lost_connection() -> None:
    for state, stronger in ((State.FAULT, {Event.ESTOP}), (State.ESTOP, set())):
        leaving = {event for event in Event if apply(state, event) is not state}
        assert leaving == {Event.RESET, Event.CONNECTION_LOST} | stronger


def test_the_control_changes_its_state_only_by_the_table() -> None:
    tree = ast.parse(Path(control.__file__).read_text())
    writers = {
        function.name
        for function in ast.walk(tree)
        if isinstance(function, ast.FunctionDef)
        for node in ast.walk(function)
        if isinstance(node, ast.Attribute)
        and node.attr == "_state"
        and isinstance(node.ctx, ast.Store)
    }
    assert writers == {"__init__", "handle"}


@pytest.mark.parametrize(("state", "event"), list(product(State, Event)))
def test_the_control_follows_the_table(state: State, event: Event) -> None:
    arm = ArmControl(Timeouts(0.02, 0.1), max_tracking_error_rad=0.12)
    arm._state = state
    arm.handle(event)
    assert arm.state is apply(state, event)
    assert arm.ready == (arm.state in READY_STATES)
    assert arm.mode == MODES[arm.state]
