"""Test that the order in which nodes start causes no fault of an arm."""

from __future__ import annotations

from dataclasses import replace

from flexsheet.nodes.arm_bridge.control import ArmControl, Timeouts
from tests.test_arm_control import HOME, Arm, on_time, pair


def new_control() -> ArmControl:
    return ArmControl(Timeouts(0.02, 0.1), max_tracking_error_rad=0.12, auto_arming=True)


def test_an_arm_that_has_never_answered_is_starting_and_has_no_fault() -> None:
    control = new_control()
    for _ in range(3):
        assert not control.on_exchange_failed("no connection to 127.0.0.1:5020", silent=True)
    assert (control.mode, control.all_faults) == ("starting", ())
    assert control.reason == "waiting for the arm: no connection to 127.0.0.1:5020"


def test_an_arm_that_answered_and_falls_silent_is_disconnected() -> None:
    arm = Arm.holding("left")
    arm.cycle(None, None)
    assert not arm.control.on_exchange_failed("no answer", silent=True)
    assert arm.control.on_exchange_failed("no answer", silent=True)
    assert (arm.control.mode, arm.control.all_faults) == ("disconnected", ("no answer",))


def test_what_answers_wrongly_from_the_start_is_a_fault() -> None:
    control = new_control()
    assert control.on_exchange_failed("status magic 0x0000: not our map", silent=False)
    assert control.all_faults == ("status magic 0x0000: not our map",)


def test_an_arm_waits_for_one_that_starts_and_then_follows_with_it() -> None:
    arms = pair()
    first = arms[1].as_other()
    arms[0].cycle(on_time(HOME), replace(first, mode=new_control().mode))
    assert (arms[0].control.mode, arms[0].control.faults) == ("idle", ())
    assert arms[0].control.reason == "waiting for the other arm"
    for _ in range(3):
        arms[0].cycle(on_time(HOME), first)
    assert arms[0].control.reason != "waiting for the other arm"
