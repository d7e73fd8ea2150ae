"""Test the benchmark of the correction methods: small errors within the range of each method."""

from __future__ import annotations

from pathlib import Path

import pytest

from flexsheet.launch.calibration.simulated_sheet import make_error_function
from flexsheet.launch.plans.plan import load_scene
from flexsheet.nodes.methods import Point, measure
from flexsheet.nodes.renderer import benchmarks, deflection_cache
from flexsheet.nodes.renderer.benchmarks import correction_family, is_in_range
from tests.indentation_bases import few_dents
from tests.scenes import make_weightless

SCENE = make_weightless(
    load_scene(Path(__file__).parents[1] / "launch" / "scenes" / "cylinder.yaml")
)


@pytest.fixture(scope="module")
def points() -> list[Point]:
    family = correction_family(make_error_function)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(deflection_cache, "load_or_compute", lambda scene, folder: few_dents())
        patch.setattr(benchmarks, "CASES", ((-50, 0), (0, 25)))
        patch.setattr(benchmarks, "scene_cases", lambda scene: ())
        return [measure(trial, repeats=1) for trial in family.trials(SCENE)]


def error(points: list[Point], method: str, tilt_deg: int, push_mm: int) -> float:
    (point,) = [
        point
        for point in points
        if point.method == method
        and (point.case["tilt_deg"], point.case["push_mm"]) == (tilt_deg, push_mm)
    ]
    assert point.in_range == is_in_range(point.method, tilt_deg=tilt_deg, push_mm=push_mm)
    return point.error


def test_a_plane_is_corrected_by_all_but_none(points: list[Point]) -> None:
    assert error(points, "none", -50, 0) > 5.0
    for method in benchmarks.METHODS[1:]:
        assert error(points, method, -50, 0) < 0.2


def test_only_two_passes_onto_the_deformed_shape_are_correct_for_it(points: list[Point]) -> None:
    uncorrected = error(points, "none", 0, 25)
    assert error(points, "one_plane", 0, 25) == pytest.approx(uncorrected, abs=0.02)
    for method in ("four_triangles", "two_pass_triangles"):
        assert 0.5 < error(points, method, 0, 25) < 0.7 * uncorrected
    assert error(points, "two_pass", 0, 25) < 0.1
