"""Where tracking fails, mildly and badly: what comes out, and how it recovers.

Error against severity over more values: `python -m benchmarks.tracking_limits`, docs/limits.md.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.tracking_bench import Frame, Observer, Seen, bench_scene, twin_camera
from nodes.twin.clutter import CLUTTER, Clutter, covered, second_mark, together, touching_highlight
from nodes.twin.pixels import Sensor, TwinCamera

Floats = NDArray[np.float64]
RATE_HZ = 60.0
BEGIN, END, LAST = 24, 48, 66
"""Frames: all is well until the first, wrong until the second, well again until the last."""

SCENE = bench_scene()
CLEAN = twin_camera(SCENE, CLUTTER["none"])
WIDE = Sensor(aperture_m=0.02, focus_m=0.5)


def place(time_s: float) -> Floats:
    return np.array([0.008 * np.sin(2.5 * time_s), 0.006 * np.cos(3.3 * time_s), 0.0])


def before(clutter: Clutter) -> TwinCamera:
    return twin_camera(SCENE, together(CLUTTER["none"], clutter))


async def follow(wrong: Callable[[int], Frame | None]) -> tuple[list[Seen], list[Seen]]:
    """The frames of the wrong time, and those after it."""
    observer = await Observer(SCENE).start()
    seen: list[tuple[int, Seen]] = []
    for number in range(1, LAST):
        frame: Frame | None = Frame(number / RATE_HZ, CLEAN)
        if BEGIN <= number < END:
            frame = wrong(number)
        if frame is not None:
            seen.append((number, await observer.show(frame, place)))
    return (
        [one for number, one in seen if BEGIN <= number < END],
        [one for number, one in seen if number >= END],
    )


def seen_by(camera: TwinCamera) -> Callable[[int], Frame]:
    return lambda number: Frame(number / RATE_HZ, camera)


def recovers(after: list[Seen], within: int) -> None:
    """Valid again after so many frames at most, and right from then on."""
    assert any(one.valid for one in after[: within + 1])
    for one in after:
        assert not one.valid or np.linalg.norm(one.error_m) < 1e-3


MILD: dict[str, Callable[[int], Frame | None]] = {
    "a second mark 30 mm away": seen_by(before(second_mark((0.03, 0.0, 0.0)))),
    "a highlight beside the mark": seen_by(before(touching_highlight(-1.0))),
    "a little out of focus": seen_by(
        twin_camera(SCENE, CLUTTER["none"], sensor=WIDE.out_of_focus(1.0, 0.5, 540.0))
    ),
    "a little over-exposed": seen_by(
        twin_camera(SCENE, CLUTTER["none"], sensor=Sensor(exposure=1.15))
    ),
    "half the frames": lambda number: Frame(number / RATE_HZ, CLEAN) if number % 2 == 0 else None,
    "a gap of 50 ms": lambda number: (
        Frame(number / RATE_HZ, CLEAN) if number >= BEGIN + 3 else None
    ),
}

SEVERE: dict[str, tuple[Callable[[int], Frame | None], set[str]]] = {
    "the mark hidden in one view": (
        seen_by(before(covered(1.0, views="right"))),
        {"mark_in_one_view"},
    ),
    "no mark": (lambda number: Frame(number / RATE_HZ, CLEAN, mark=False), {"no_mark"}),
    "a second mark that touches": (
        seen_by(before(second_mark((0.006, 0.0, 0.0)))),
        {"merged", "two_marks", "blurred"},
    ),
    "a highlight on the mark": (
        seen_by(before(touching_highlight(0.5))),
        {"merged", "blurred"},
    ),
    "far out of focus": (
        seen_by(twin_camera(SCENE, CLUTTER["none"], sensor=WIDE.out_of_focus(4.0, 0.5, 540.0))),
        {"no_mark", "blurred", "merged", "mark_in_one_view", "inconsistent"},
    ),
    "white all over": (
        seen_by(twin_camera(SCENE, CLUTTER["none"], sensor=Sensor(exposure=12.0))),
        {"saturated", "no_mark", "inconsistent", "merged"},
    ),
}


@pytest.mark.parametrize("name", MILD)
async def test_what_is_mild_is_lived_with(name: str) -> None:
    during, after = await follow(MILD[name])
    assert len(during) >= 10
    assert all(one.valid for one in during), {one.reason for one in during}
    errors = np.array([np.linalg.norm(one.error_m) for one in during])
    assert errors.max() < 6e-4
    recovers(after, within=0)


@pytest.mark.parametrize("name", SEVERE)
async def test_what_is_severe_is_refused_with_its_reason(name: str) -> None:
    wrong, reasons = SEVERE[name]
    during, after = await follow(wrong)
    assert not any(one.valid for one in during[1:])
    assert {one.reason for one in during[1:]} <= reasons
    recovers(after, within=3)


async def test_another_mark_is_not_taken_while_the_finger_is_hidden() -> None:
    """It was seen beside the finger before, so it is known for what it is."""
    other = (0.04, 0.02, 0.0)
    observer = await Observer(SCENE).start()
    both, alone = before(second_mark(other)), before(together(second_mark(other), covered(1.0)))
    for number in range(1, 12):
        await observer.show(Frame(number / RATE_HZ, CLEAN), place)
    for number in range(12, 40):
        await observer.show(Frame(number / RATE_HZ, both), place)
    hidden = [
        await observer.show(Frame(number / RATE_HZ, alone), place) for number in range(40, 64)
    ]
    assert not any(one.valid for one in hidden)
    again = [await observer.show(Frame(number / RATE_HZ, both), place) for number in range(64, 70)]
    recovers(again, within=3)


@pytest.mark.parametrize("step_s", [-10.0, -0.1, 0.05, 10.0])
async def test_a_step_of_the_cameras_clock_costs_two_frames_and_no_error(step_s: float) -> None:
    observer = await Observer(SCENE).start()
    seen = []
    for number in range(1, LAST):
        time_s = number / RATE_HZ
        stamp_s = 100.0 + time_s + (step_s if number >= BEGIN else 0.0)
        seen.append(await observer.show(Frame(time_s, CLEAN, stamp_s=stamp_s), place))
    after = seen[BEGIN - 1 :]
    assert sum(not one.valid for one in after) <= 2
    recovers(after, within=2)
