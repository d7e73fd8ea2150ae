"""Test the surface of the untouched sheet in the evaluation of experiments."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from flexsheet.launch.experiments import stroke
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.scene import Scene
from flexsheet.nodes.models.rigid import rotation_from_vector, transform
from flexsheet.nodes.models.sheet.tension import compute_sag_m
from flexsheet.nodes.planner.sheet_force import make_rubber
from flexsheet.nodes.twin.membrane import solve
from flexsheet.nodes.twin.sheet_pull import true_rubber
from flexsheet.nodes.twin.sheet_surface import SheetSurface
from tests.scenes import make_weightless

SCENE = load_scene(Path(__file__).parent.parent / "launch" / "scenes" / "cylinder.yaml")
RADIUS = 0.0353553
TIMES = np.arange(9, dtype=np.int64) * 10_000_000
ANGLES = np.linspace(-1.0, 1.0, len(TIMES))
UP = np.array([0.0, 1.0, 0.0])


@cache
def surface(modulus_ratio: float = 1.0) -> SheetSurface:
    return SheetSurface.of(
        SCENE,
        Apparatus.model_validate({"scene": "cylinder", "sheet": {"modulus_ratio": modulus_ratio}}),
    )


def edges_at(stretch: float, lean_rad: float) -> list[np.ndarray]:
    rotation = rotation_from_vector(np.array([lean_rad, 0.0, 0.0]))
    half_m = 0.5 * stretch * SCENE.sheet.width_m
    return [transform(rotation, rotation @ [side * half_m, 0.0, 0.0]) for side in (-1.0, 1.0)]


@pytest.mark.parametrize(("stretch", "lean_rad"), [(1.022, 0.9), (1.047, -0.6), (1.075, 0.2)])
def test_the_surface_is_that_of_the_membrane(stretch: float, lean_rad: float) -> None:
    left, right = edges_at(stretch, lean_rad)
    solved = solve(true_rubber(SCENE.sheet, None), left, right, cells=12).positions
    near = solved[3:-3, 2:-2].reshape(-1, 3)
    planes = stroke.SheetPlanes(
        np.zeros_like(near),
        np.tile(left[:3, 2], (len(near), 1)),
        np.tile(left[:3, 0], (len(near), 1)),
        np.full(len(near), stretch * SCENE.sheet.width_m),
    )
    found = surface().find_tangent_planes(planes, near, UP)
    largest_m = np.abs(near @ left[:3, 2]).max()
    assert largest_m > 2e-4
    np.testing.assert_allclose(found.points, near, atol=0.01 * largest_m)
    slopes = np.abs(np.einsum("ij,ij->i", found.normals, planes.normals))
    assert slopes.min() < np.cos(2.0 * largest_m / SCENE.sheet.width_m)


def errors_of(scene: Scene, *, compensated: bool, true: SheetSurface) -> np.ndarray:
    """Return the surface errors of edges in the tangent plane, or behind the plane by the planned
    sag.
    """
    normals = np.column_stack([np.zeros_like(ANGLES), np.sin(ANGLES), np.cos(ANGLES)])
    along = np.column_stack([np.zeros_like(ANGLES), np.cos(ANGLES), -np.sin(ANGLES)])
    contact = RADIUS * normals - [0.0, 0.0, RADIUS]
    behind = np.zeros(len(ANGLES))
    if compensated:
        behind = np.array(
            [
                compute_sag_m(
                    make_rubber(scene.sheet),
                    normal,
                    density_kg_per_m3=scene.sheet.density_kg_per_m3,
                    edge_distance_m=0.25,
                    across=0.5,
                )
                for normal in normals
            ]
        )
    centre = contact - behind[:, None] * normals
    left, right = (
        stroke.SampledMotion(
            TIMES, np.hstack([centre + np.array([half_m, 0.0, 0.0]), along, normals])
        )
        for half_m in (-0.125, 0.125)
    )
    finger = stroke.SampledMotion(TIMES, contact)
    return stroke.sheet_errors(scene, finger, (left, right), TIMES, surface=true)[0]


def test_compensated_sag_is_no_error() -> None:
    plain = errors_of(SCENE, compensated=False, true=surface())
    compensated = errors_of(SCENE, compensated=True, true=surface())
    assert plain.max() > 1e-3
    assert compensated.max() < 2e-5 + 0.03 * plain.max()


def test_a_softer_sheet_sags_more_than_the_planner_compensates() -> None:
    soft = errors_of(SCENE, compensated=True, true=surface(0.8))
    nominal = errors_of(SCENE, compensated=True, true=surface())
    assert soft.max() > nominal.max() + 1e-4


def test_a_sheet_without_weight_is_flat() -> None:
    scene = make_weightless(SCENE)
    flat = SheetSurface.of(scene)
    np.testing.assert_allclose(errors_of(scene, compensated=False, true=flat), 0.0, atol=1e-12)
