"""Test that projected marks, as the stereo camera sees them, show which device has moved.

The truth is a drawn apparatus with the residuals of its calibrations: the simulator's projector
lights the simulator's sheet. The checks see triangulated points and the renderer's expectations.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pytest

from flexsheet.messages.scene import Projector
from flexsheet.messages.types import Frame
from flexsheet.nodes.models.rigid import transform
from flexsheet.nodes.models.sheet import corners
from flexsheet.nodes.renderer.check_marks import FINGER_STEP_M, CheckMarks, place_marks
from flexsheet.nodes.renderer.sheet import SheetPose
from flexsheet.nodes.renderer.sheet_mesh import SheetMesh, deflected_mesh
from flexsheet.nodes.triangulator.projection_check import ProjectionCheck
from flexsheet.nodes.triangulator.self_checks import CameraCheck
from flexsheet.nodes.twin.eye import TrueProjector
from flexsheet.nodes.twin.membrane import solve
from flexsheet.nodes.twin.sheet_pull import true_rubber
from flexsheet.nodes.twin.tolerance_table import sample_apparatus
from flexsheet.nodes.twin.truth import apply_apparatus
from tests.indentation_bases import few_dents
from tests.test_self_checks import MARKS, SCENE, Fault, View, suspected

PLACES = (
    (-0.06, 0.06), (0.06, 0.05), (-0.035, 0.025), (0.03, -0.03), (0.055, -0.05), (-0.06, -0.06),
)  # fmt: skip
assert SCENE.projector is not None
PROJECTOR: Projector = SCENE.projector.model_copy(update={"check_marks_sheet_m": PLACES})
STRETCH = 1.05
PUSH_M = np.array([0.0, 0.0, -0.010])
FRAME_S = 0.2


@dataclass(frozen=True)
class Change:
    """Change of a calibrated apparatus: shifts, m, of devices in the world, and a delay, s."""

    camera_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    projector_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    arms_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    marker_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    latency_s: float = 0.0


def edges(centre: Any) -> tuple[Any, Any]:
    half = [0.5 * STRETCH * SCENE.sheet.width_m, 0.0, 0.0]
    return transform(np.eye(3), centre - half), transform(np.eye(3), centre + half)


@cache
def believe(
    place: tuple[float, ...], finger: tuple[float, ...] | None
) -> tuple[SheetPose, CheckMarks]:
    """Return the renderer's sheet at a centre (3,) for a measured finger (3,), and its marks."""
    centre, pad = np.array(place), None if finger is None else np.array(finger)
    pose = SheetPose(
        transform(np.eye(3), centre), corners(*edges(centre), SCENE.sheet.height_m), pad
    )

    def mesh(finger: Any | None) -> SheetMesh:
        pushed = SheetPose(pose.world_from_sheet, pose.corners, finger)
        return deflected_mesh(pushed, few_dents())

    deeper = None if pad is None else mesh(pad - [0.0, 0.0, FINGER_STEP_M])
    return pose, place_marks(PROJECTOR, pose.world_from_sheet, mesh(pad), deeper)


@cache
def draw(seed: int) -> tuple[Any, Any, Any]:
    """Return a calibrated apparatus, its scene, and the shift of its arms (3,)."""
    apparatus = sample_apparatus(SCENE, seed, calibrated=True)
    each = [
        np.add(arm.base_position_offset_m, arm.edge_position_offset_m)
        for arm in (apparatus.arms.left, apparatus.arms.right)
    ]
    return apparatus, apply_apparatus(SCENE, apparatus), np.mean(each, axis=0)


def light(seed: int, change: Change, centre: Any, pixels: Any, finger: Any | None) -> Any:
    """Return the points (n, 3) that pixels light on the true sheet."""
    apparatus, scene, arms_m = draw(seed)
    pose = scene.projector.world_from_projector
    moved = pose.model_copy(update={"position_m": pose.position_m + np.array(change.projector_m)})
    projector = scene.projector.model_copy(update={"world_from_projector": moved})
    true_centre = centre + arms_m + np.array(change.arms_m)
    if finger is None:
        vertices = np.array(corners(*edges(true_centre), SCENE.sheet.height_m))
        triangles = np.array([[0, 1, 2], [0, 2, 3]])
    else:
        rubber = true_rubber(scene.sheet, apparatus)
        sheet = solve(rubber, *edges(true_centre), finger_tip=finger, cells=16)
        vertices, triangles = sheet.positions.reshape(-1, 3), sheet.triangles()
    points, lands = TrueProjector(projector, vertices, triangles).intersect_surface(pixels)
    assert lands.all()
    return points


def observe(
    seed: int, change: Change, *, seconds: float = 10.0, pushed: bool = False, moving: bool = False,
    reference_marks: bool = True, image_s: float = 0.1,
) -> Iterator[set[str]]:  # fmt: skip
    """Yield the suspected causes after each image pair."""
    view = View(seed, Fault(camera_m=change.camera_m))
    check = CameraCheck(MARKS if reference_marks else np.zeros((0, 3)), None, PROJECTOR)
    true_pad = PUSH_M if pushed else None
    calibration_m = 3e-4 * np.random.default_rng((seed, 22)).standard_normal(3)
    pad = tuple((PUSH_M + calibration_m + change.marker_m).tolist()) if pushed else None
    shown: list[tuple[float, Any]] = []
    places: dict[bytes, Any] = {}
    for number in range(round(seconds / image_s)):
        now_s = image_s * number
        if number % round(FRAME_S / image_s) == 0:
            swing_m = 0.04 * np.sin(2.0 * np.pi * 0.25 * now_s) if moving else 0.0
            pose, marks = believe((swing_m, 0.0, 0.0), pad)
            shown.append((now_s + change.latency_s, marks.centres_px))
            check.on_frame(
                Frame.model_construct(
                    light_ns=1 + round(1e9 * now_s),
                    world_from_sheet=pose.world_from_sheet,
                    marks_px=marks.centres_px,
                    marks_world_m=marks.world_m,
                    marks_finger_ratio=marks.finger_ratio,
                )
            )
        # Images are taken soon after a frame has appeared, and long after.
        at_s = now_s + (0.015 if number % 2 else 0.01)
        visible = [pixels for light_s, pixels in shown if light_s <= at_s]
        if not visible:
            continue
        key = visible[-1].tobytes() + bytes(str(number if moving else 0), "ascii")
        if key not in places:
            swing_m = 0.04 * np.sin(2.0 * np.pi * 0.25 * at_s) if moving else 0.0
            centre = np.array([swing_m, 0.0, 0.0])
            places[key] = light(seed, change, centre, visible[-1], true_pad)
        points, _ = view.see(np.concatenate([places[key], MARKS]))
        check.on_marks(list(points), 1 + round(1e9 * at_s))
        yield suspected(check.results())


@pytest.mark.parametrize(
    ("change", "pushed", "cause"),
    [
        (Change(projector_m=(0.0, 0.002, 0.0)), False, "projector_moved"),
        (Change(arms_m=(0.0, 0.0, -0.002)), False, "arm_base_moved"),
        (Change(camera_m=(0.0, 0.0, 0.001)), False, "camera_moved"),
        (Change(camera_m=(0.001, 0.0, 0.0)), False, "camera_moved"),
        (Change(marker_m=(0.0, 0.0, -0.003)), True, "marker_offset"),
        (Change(marker_m=(0.0, 0.0, 0.003)), True, "marker_offset"),
    ],
)
def test_projected_marks_name_the_device_that_moved(
    change: Change, pushed: bool, cause: str
) -> None:
    *_, last = observe(110, change, pushed=pushed)
    assert last == {cause}


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (Change(camera_m=(0.0, 0.0015, 0.0025)), "camera_moved"),
        (Change(projector_m=(0.0, 0.002, 0.0)), "camera_or_projector_moved"),
        (Change(arms_m=(0.0, 0.0, -0.002)), "camera_or_arm_base_moved"),
    ],
)
def test_without_reference_marks_the_cause_is_less_specific(change: Change, cause: str) -> None:
    *_, last = observe(111, change, reference_marks=False)
    assert last == {cause}


def test_a_late_display_is_named_while_the_sheet_moves() -> None:
    assert any(
        "display_latency" in causes for causes in observe(110, Change(latency_s=0.03), moving=True)
    )
    assert not set().union(*observe(110, Change(), moving=True))


@pytest.mark.parametrize(
    ("seed", "pushed", "minutes"),
    [
        (101, True, 3),
        *(
            pytest.param(seed, pushed, 10, marks=pytest.mark.long)
            for seed, pushed in ((100, False), (101, True))
        ),
    ],
)
def test_calibrated_devices_raise_no_suspicion(seed: int, pushed: bool, minutes: int) -> None:
    seconds = 60.0 * minutes
    assert not set().union(*observe(seed, Change(), seconds=seconds, image_s=0.2, pushed=pushed))


def test_marks_are_drawn_on_whole_pixels_at_half_resolution() -> None:
    _, marks = believe((0.0, 0.0, 0.0), None)
    assert marks.side_px % 2 == 0
    assert not (marks.corners_px % 2).any()


def test_another_bright_point_and_a_mark_beside_the_sheet_are_ignored() -> None:
    check = ProjectionCheck(PROJECTOR)
    world = np.array([(x, y, 0.0) for x, y in PLACES])
    world[-1] = np.nan
    points = [*world[:-1]]
    points[0] = points[0] + [0.008, 0.0, 0.0]
    for number in range(60):
        light_ns = 1 + round(1e9 * FRAME_S * number)
        show_marks(check, light_ns, world, np.zeros(len(world)))
        check.on_points(points, np.zeros(3), light_ns + 1)
    results = check.results(camera_checked=True)
    assert set(results) == {"projector_moved", "arm_base_moved"}
    assert results["projector_moved"].value == pytest.approx(0.0, abs=1e-9)


def show_marks(check: ProjectionCheck, light_ns: int, world: Any, ratios: Any) -> None:
    """Pass a frame of a sheet in the plane z = 0 to the check."""
    check.on_frame(
        Frame.model_construct(
            light_ns=light_ns,
            world_from_sheet=np.eye(4),
            marks_world_m=world,
            marks_finger_ratio=np.asarray(ratios),
        )
    )


def check_heights(
    heights_m: Any, ratios: Any, *, turning_rad_per_s: float = 0.0
) -> ProjectionCheck:
    """Return the check after 12 s in which the marks are seen above the expected surface.

    heights_m, ratios (n,): heights of the marks, and their displacement ratios. turning_rad_per_s:
    angular velocity of the expected sheet about its y axis.
    """
    check = ProjectionCheck(PROJECTOR)
    flat = np.array([(x, y, 0.0) for x, y in PLACES])
    for number in range(60):
        light_ns = 1 + round(1e9 * FRAME_S * number)
        expected = flat + np.array([0.0, 0.0, 1.0]) * (
            turning_rad_per_s * FRAME_S * number * flat[:, :1]
        )
        show_marks(check, light_ns, expected, np.asarray(ratios))
        seen = expected + np.outer(heights_m, [0.0, 0.0, 1.0])
        check.on_points(list(seen), np.zeros(3), light_ns + 100_000_000)
    return check


def test_heights_are_not_checked_while_the_sheet_turns() -> None:
    heights = np.full(len(PLACES), 0.002)
    still = check_heights(heights, np.zeros(len(PLACES))).results(camera_checked=True)
    assert still["arm_base_moved"].suspected
    turning = check_heights(heights, np.zeros(len(PLACES)), turning_rad_per_s=0.1)
    assert set(turning.results(camera_checked=True)) == {"projector_moved"}


def test_the_finger_depth_is_not_estimated_from_marks_far_from_the_finger() -> None:
    far = np.array([0.05, 0.15, 0.03, 0.02, 0.01, 0.0])
    near = np.array([0.05, 0.6, 0.03, 0.5, 0.01, 0.0])
    heights = 0.003 * near
    assert "marker_offset" not in check_heights(heights, far).results(camera_checked=True)
    found = check_heights(heights, near).results(camera_checked=True)["marker_offset"]
    assert found.suspected
    assert found.value == pytest.approx(0.003)


def test_a_point_belongs_to_one_mark_only() -> None:
    check = ProjectionCheck(
        PROJECTOR.model_copy(
            update={"check_marks_sheet_m": ((0.0, 0.0), (0.0, 0.003), (0.05, 0.0))}
        )
    )
    world = np.array([(0.0, 0.0, 0.0), (0.0, 0.003, 0.0), (0.05, 0.0, 0.0)])
    for number in range(60):
        light_ns = 1 + round(1e9 * FRAME_S * number)
        show_marks(check, light_ns, world, np.zeros(3))
        hidden = world[[0, 2]]
        check.on_points(list(hidden), np.zeros(3), light_ns + 1)
    assert check.results(camera_checked=True)["projector_moved"].value == pytest.approx(0.0)
