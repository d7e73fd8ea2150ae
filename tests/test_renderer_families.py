"""The correction family: errors as the geometry says, and ranges that hold."""

from __future__ import annotations

from pathlib import Path

import pytest
from ruamel.yaml import YAML

from messages.scene import Scene
from nodes.methods import Point, measure
from nodes.renderer import families
from nodes.renderer.families import correction_family, covers
from nodes.twin.eye import seen_at

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def points() -> list[Point]:
    path = ROOT / "launch" / "scenes" / "cylinder.yaml"
    scene = Scene.model_validate(YAML(typ="safe").load(path.read_text()))
    family = correction_family(seen_at)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(families, "TILTS_DEG", (-50, 50))
        patch.setattr(families, "PUSHES_MM", (0, 30))
        return [measure(trial, repeats=1) for trial in family.trials(scene)]


def error(points: list[Point], method: str, tilt_deg: int, push_mm: int) -> float:
    (point,) = [
        point
        for point in points
        if point.method == method and point.params == {"tilt_deg": tilt_deg, "push_mm": push_mm}
    ]
    assert point.in_range == covers(point.method, tilt_deg=tilt_deg, push_mm=push_mm)  # type: ignore[arg-type]  # one of three names
    return point.error


def test_a_plane_is_corrected_by_both_methods(points: list[Point]) -> None:
    for tilt in (-50, 50):
        assert error(points, "none", tilt, 0) > 5.0
        assert error(points, "one_plane", tilt, 0) < 1e-3
        assert error(points, "four_triangles", tilt, 0) < 1e-3


def test_nothing_needs_correcting_on_the_imaginary_screen(points: list[Point]) -> None:
    for method in ("none", "one_plane", "four_triangles"):
        assert error(points, method, 0, 0) < 1e-3


def test_four_triangles_help_on_a_dent_but_do_not_hold_it(points: list[Point]) -> None:
    uncorrected = error(points, "none", 0, 30)
    corrected = error(points, "four_triangles", 0, 30)
    assert error(points, "one_plane", 0, 30) == pytest.approx(uncorrected, abs=1e-6)
    assert 0.5 < corrected < 0.7 * uncorrected
