"""Test the calibration of the clamped edges, and the arm commands that use its result."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexsheet.launch.calibration.edge_fit import EdgeFit, EdgeFitError, HeldPose, fit_edges
from flexsheet.launch.calibration.edge_marks import (
    ALONG,
    COLUMNS,
    EdgeMarkRecorder,
    read_edge_marks,
    simulate_edge_marks,
)
from flexsheet.launch.experiments.true_geometry import ArmPair, place_edges
from flexsheet.launch.plans.documents import BadInputError
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.apparatus import ArmsTruth, ArmTruth, CameraTruth, nominal_apparatus
from flexsheet.messages.calibration import StereoCalibration
from flexsheet.messages.scene import ArmSpec, Scene
from flexsheet.messages.types import Side
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.models.motion import SheetMotion
from flexsheet.nodes.models.rigid import apply, rotation_from_vector, transform
from flexsheet.nodes.twin.pixels import TwinCamera
from flexsheet.nodes.twin.rig import make_true_camera
from flexsheet.nodes.twin.tolerance_table import sample_apparatus

LAUNCH = Path(__file__).resolve().parent.parent / "launch"
SCENE = load_scene(LAUNCH / "scenes" / "cylinder.yaml")
OPTICS = StereoCalibration.load(LAUNCH / "calibrations" / "twin-bumblebee.yaml")
OFFSETS_RAD = (3e-4, -5e-4, 4e-4, 6e-4, -2e-4, 5e-4)
COMPLIANCES_M_PER_N = {"left": 120e-6, "right": 40e-6}


def with_arms(scene: Scene, **arms: ArmSpec) -> Scene:
    return scene.model_copy(update={"arms": scene.arms.model_copy(update=arms)})


def deviating_scene() -> Scene:
    """Return a scene in which the nodes know joint offsets and compliances."""
    specs = {
        side: getattr(SCENE.arms, side).model_copy(
            update={
                "joint_offsets_rad": OFFSETS_RAD,
                "flange_compliance_m_per_n": COMPLIANCES_M_PER_N[side],
            }
        )
        for side in ("left", "right")
    }
    return with_arms(SCENE, **specs)


def draw_edges(random: np.random.Generator, stretch: float) -> tuple[Any, Any]:
    rotation = rotation_from_vector(random.uniform(-0.2, 0.2, 3))
    pose = transform(rotation, random.uniform(-0.02, 0.02, 3))
    return place_edges(pose, stretch * SCENE.sheet.width_m)


@cache
def held_poses(seed: int) -> tuple[Any, list[HeldPose]]:
    # The camera's own errors are left out, since they are common to marks and finger.
    apparatus = sample_apparatus(SCENE, seed).model_copy(update={"camera": CameraTruth()})
    return apparatus, simulate_edge_marks(SCENE, apparatus, calibration=OPTICS, seed=seed)


@cache
def fitted_edges(seed: int) -> dict[Side, EdgeFit]:
    return fit_edges(held_poses(seed)[1], SCENE)


@pytest.mark.parametrize("seed", [3, pytest.param(11, marks=pytest.mark.long)])
def test_fitted_arms_hold_the_edges_where_they_are_commanded(seed: int) -> None:
    apparatus, _ = held_poses(seed)
    fits = fitted_edges(seed)
    measured = with_arms(SCENE, **{side: fit.arm for side, fit in fits.items()})
    random = np.random.default_rng(seed + 1000)
    errors: dict[str, list[float]] = {"before": [], "after": []}
    for _ in range(20):
        edges = draw_edges(random, random.uniform(1.01, 1.06))
        for name, scene in (("before", SCENE), ("after", measured)):
            held = ArmPair(scene, apparatus).hold(edges)
            errors[name] += [
                float(np.linalg.norm(one[:3, 3] - other[:3, 3]))
                for one, other in zip(held, edges, strict=True)
            ]
    before_m, after_m = (float(np.sqrt(np.mean(np.square(errors[one])))) for one in errors)
    assert before_m > 1e-3
    assert after_m < 1e-4
    stated_m = max(fit.edge_std_m for fit in fits.values())
    assert 0.3 < after_m / stated_m < 3.0
    for side, fit in fits.items():
        # The scene's tension is wrong by the ratio of the moduli, and so is the compliance.
        stiffer = apparatus.sheet.modulus_ratio * apparatus.sheet.thickness_ratio
        true = stiffer * getattr(apparatus.arms, side).flange_compliance_m_per_n
        assert fit.arm.flange_compliance_m_per_n == pytest.approx(true, rel=0.2)


def test_arms_that_equal_the_scene_need_no_correction() -> None:
    scene = deviating_scene()
    edges = draw_edges(np.random.default_rng(5), 1.04)
    held = ArmPair(scene, nominal_apparatus(scene)).hold(edges)
    for one, other in zip(held, edges, strict=True):
        # Friction-free rubber by another model of its tension, and the sheet's weight, remain.
        assert np.linalg.norm(one[:3, 3] - other[:3, 3]) < 1.5e-4


@pytest.mark.parametrize("stretch", [1.0, 1.03, 1.08])
def test_the_bridge_measures_the_sheet_that_it_commands(stretch: float) -> None:
    scene = deviating_scene()
    rotation = rotation_from_vector(np.array([0.2, -0.1, 0.05]))
    motion = SheetMotion(
        transform(rotation, np.array([0.01, -0.02, 0.015])), np.zeros(6), stretch, 0.0
    )
    arms = [ArmGeometry(scene, side) for side in ("left", "right")]
    joints = [arm.joints_for_sheet(motion, arm.start_rad) for arm in arms]
    rigid = [arm.world_from_edge(rad) for arm, rad in zip(arms, joints, strict=True)]
    for arm, own, other in ((arms[0], rigid[0], rigid[1]), (arms[1], rigid[1], rigid[0])):
        between = arm.sheet_between(own, other)
        assert between.stretch_ratio == pytest.approx(stretch, abs=1e-6)
        np.testing.assert_allclose(between.world_from_sheet, motion.world_from_sheet, atol=1e-6)
    length_m, force_n = arms[0].sheet_state(joints[0], arms[1].world_from_flange(joints[1]))
    assert length_m == pytest.approx(stretch * scene.sheet.width_m, abs=1e-6)
    assert (force_n or 0.0) == pytest.approx(arms[0].sheet_limits.force_n(length_m or 0.0))
    tension = ArmGeometry(SCENE, "left").sheet_limits.force_n(stretch * SCENE.sheet.width_m)
    assert force_n == pytest.approx(tension, abs=1e-2)


def test_too_few_poses_and_confused_arms_are_refused() -> None:
    _, poses = held_poses(3)
    with pytest.raises(EdgeFitError, match=r"left arm: .* in 5 poses, but at least 8 are needed"):
        fit_edges(poses[:5], SCENE)
    confused = [
        replace(pose, left_rad=other.left_rad)
        for pose, other in zip(poses, [*poses[1:], poses[0]], strict=True)
    ]
    with pytest.raises(
        EdgeFitError, match="check which mark, arm and joint angles belong together"
    ):
        fit_edges(confused, SCENE)


def test_one_wrong_mark_hardly_matters() -> None:
    _, poses = held_poses(3)
    first = poses[0]
    wrong = replace(
        first.marks[0], position_world_m=first.marks[0].position_world_m + np.array([0, 8e-3, 0])
    )
    corrupted = [replace(first, marks=(wrong, *first.marks[1:])), *poses[1:]]
    clean, other = fitted_edges(3)["left"].arm, fit_edges(corrupted, SCENE)["left"].arm
    arms = [ArmGeometry(with_arms(SCENE, left=arm), "left") for arm in (clean, other)]
    joints = poses[3].left_rad
    one, two = (arm.world_from_edge(joints)[:3, 3] for arm in arms)
    assert np.linalg.norm(one - two) < 1e-4


class TestRecorder:
    """The recorder writes the file that the fit reads."""

    def record(self, path: Path, *, rests: bool) -> tuple[EdgeMarkRecorder, list[str]]:
        apparatus = nominal_apparatus(SCENE).model_copy(
            update={"arms": ArmsTruth(left=ArmTruth(), right=ArmTruth())}
        )
        arms = ArmPair(SCENE, apparatus)
        recorder = EdgeMarkRecorder(path, SCENE, OPTICS)
        camera = TwinCamera(
            make_true_camera(SCENE.camera), finger_radius_m=SCENE.finger.radius_m, seed=2
        )
        random, hints = np.random.default_rng(1), []
        for number in range(2):
            edges = draw_edges(random, 1.03)
            left_rad, right_rad = arms.solve_joints(edges)
            time_s = 10.0 * number
            recorder.update_joints("left", left_rad, time_s)
            recorder.update_joints("right", right_rad, time_s)
            marks = [apply(edge, np.array([0.0, 0.0, 0.0])) for edge in edges]
            images = [
                camera.picture(lambda _, at=mark: at, exposure_s=SCENE.camera.exposure_s)
                for mark in marks
            ]
            both = [np.maximum(images[0][eye], images[1][eye]) for eye in (0, 1)]
            hints.append(recorder.update_images(*both, time_s + (1.0 if rests else 0.1)))
        return recorder, hints

    def test_records_marks_of_resting_arms(self, tmp_path: Path) -> None:
        recorder, hints = self.record(tmp_path / "marks.csv", rests=True)
        assert recorder.count == 2, hints
        poses = read_edge_marks(tmp_path / "marks.csv")
        assert len(poses) == 2
        assert {mark.side for mark in poses[0].marks} == {"left", "right"}
        arm = ArmGeometry(SCENE, "left")
        mark = next(one for one in poses[0].marks if one.side == "left")
        expected = apply(arm.world_from_edge(poses[0].left_rad), mark.mark_edge_m)
        assert mark.mark_edge_m[1] == pytest.approx(ALONG[1])
        assert np.linalg.norm(mark.position_world_m - expected) < 1e-3

    def test_does_not_record_moving_arms(self, tmp_path: Path) -> None:
        recorder, hints = self.record(tmp_path / "marks.csv", rests=False)
        assert recorder.count == 0
        assert set(hints) == {"the arms are moving"}


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("side", "middle", 'expected left or right, found "middle"'),
        ("x_mm", "nan", 'x_mm: expected a finite number, found "nan"'),
        ("left_j3_deg", "", 'left_j3_deg: expected a number, found ""; write a number'),
    ],
)
def test_wrong_rows_are_named(tmp_path: Path, column: str, value: str, message: str) -> None:
    row = dict.fromkeys(COLUMNS, "1.0") | {"side": "left"} | {column: value}
    path = tmp_path / "marks.csv"
    path.write_text(f"{','.join(COLUMNS)}\n{','.join(row.values())}\n")
    with pytest.raises(BadInputError) as caught:
        read_edge_marks(path)
    assert message in str(caught.value)
    assert f"{path}:2" in str(caught.value)


def test_a_missing_column_is_named(tmp_path: Path) -> None:
    path = tmp_path / "marks.csv"
    path.write_text("pose,side\n1,left\n")
    with pytest.raises(BadInputError, match="along_mm: missing column"):
        read_edge_marks(path)
