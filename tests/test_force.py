"""Test the calibration of the sheet from a recording with measured forces."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from flexsheet.launch.calibration.sheet_bag import read_pushes, select_pushes
from flexsheet.launch.calibration.sheet_fit import MeasuredPush, SheetModelFitError
from flexsheet.launch.cli import app
from flexsheet.launch.commands.calibrate_sheet import make_calibration
from flexsheet.launch.experiments.stroke import SampledMotion
from flexsheet.messages.apparatus import Apparatus, SheetTruth
from flexsheet.messages.bag import BagWriter
from flexsheet.messages.base import Header, Message
from flexsheet.messages.sheet_calibration import SheetCalibration
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import Force
from flexsheet.nodes.models.rigid import inverse, transform, transform_from_rpy
from flexsheet.nodes.planner.self_checks import check_stiffness
from flexsheet.nodes.planner.sheet_force import make_force_model
from flexsheet.nodes.twin.force_history import ForceHistory
from flexsheet.nodes.twin.membrane import make_edge_plane
from flexsheet.nodes.twin.sheet_pull import find_clamps, solve_sheet
from flexsheet.nodes.twin.truth import apply_apparatus
from tests.arm_states import arm_state
from tests.fingertips import fingertip
from tests.test_planner import SCENE

Floats = NDArray[np.float64]
SHEET = SCENE.sheet
EXPECTED = SHEET.young_modulus_pa * SHEET.thickness_m


def force(newtons: float, *, valid: bool = True) -> Force:
    return Force(
        valid=valid,
        force_n=newtons,
        standard_deviation_n=0.02,
    )


def flanges(stretch_ratio: float) -> tuple[Floats, Floats]:
    """Return the flange poses for a stretched sheet in the plane z = 0."""
    half_m = 0.5 * stretch_ratio * SHEET.width_m
    found = []
    for side, arm in ((-1.0, SCENE.arms.left), (1.0, SCENE.arms.right)):
        pose = arm.flange_from_edge
        clamp = transform_from_rpy(pose.position_m, pose.rpy_rad)
        found.append(transform(np.eye(3), [side * half_m, 0.0, 0.0]) @ inverse(clamp))
    return found[0], found[1]


@dataclass
class Recorded:
    """Fingertips, flange poses and forces of simulated pushes. Each depth lasts one second."""

    apparatus: Apparatus | None
    stretches: tuple[float, ...] = (1.03,)
    times: list[int] = field(default_factory=list)
    tips: list[Floats] = field(default_factory=list)
    left: list[Floats] = field(default_factory=list)
    right: list[Floats] = field(default_factory=list)
    forces: list[tuple[int, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        truth = apply_apparatus(SCENE, self.apparatus)
        history = ForceHistory.of(self.apparatus)
        clamps = find_clamps(truth)
        random = np.random.default_rng(4)
        now_ns = 10**9
        for stretch_ratio in self.stretches:
            left, right = flanges(stretch_ratio)
            for depth_m in (-0.01, 0.006, 0.012, 0.02, 0.03, 0.015, 0.008):
                tip = np.array([0.01, 0.005, -depth_m])
                newtons, edges = 0.0, (left @ clamps[0], right @ clamps[1])
                if depth_m > 0.0:
                    pressed = solve_sheet(truth, self.apparatus, edges, tip, cells=12)
                    newtons = float(pressed.finger_force_n @ make_edge_plane(*edges)[:3, 2])
                if history is not None:
                    newtons = history.update(1e-9 * now_ns, newtons)
                for step in range(50):
                    self.times.append(now_ns + step * 20_000_000)
                    self.tips.append(tip + random.normal(0.0, 5e-5, 3))
                    self.left.append(left.ravel())
                    self.right.append(right.ravel())
                for step in (20, 30):
                    noisy_n = newtons + float(random.normal(0.0, 0.01))
                    self.forces.append((now_ns + step * 20_000_000, noisy_n))
                now_ns += 10**9

    def pushes(self) -> list[MeasuredPush]:
        times = np.array(self.times)
        tips, left, right = (
            SampledMotion(times, np.array(rows)) for rows in (self.tips, self.left, self.right)
        )
        return select_pushes(SCENE, self.forces, tips, left, right)


def test_pushes_are_selected_where_the_finger_rests_in_the_sheet() -> None:
    pushes = Recorded(None).pushes()
    assert len(pushes) == 12
    assert [push.unloading for push in pushes] == [False] * 8 + [True] * 4
    assert pushes[2].depth_m == pytest.approx(0.012, abs=2e-4)
    assert pushes[2].position_m == pytest.approx((0.01, 0.005), abs=2e-4)
    assert pushes[2].edge_distance_m == pytest.approx(1.03 * SHEET.width_m)


def test_pushes_in_motion_and_in_gaps_are_not_used() -> None:
    times = np.arange(0, 3 * 10**9, 20_000_000)
    moving = np.column_stack([np.zeros((len(times), 2)), -0.01 - 2e-11 * times])
    left, right = (
        SampledMotion(times, np.tile(pose.ravel(), (len(times), 1))) for pose in flanges(1.03)
    )
    tips = SampledMotion(times, moving)
    assert select_pushes(SCENE, [(10**9, 1.0)], tips, left, right) == []
    resting = SampledMotion(times, np.tile([0.0, 0.0, -0.01], (len(times), 1)))
    late_ns = int(times[-1]) + 200_000_000
    assert len(select_pushes(SCENE, [(10**9, 1.0)], resting, left, right)) == 1
    assert select_pushes(SCENE, [(late_ns, 1.0)], resting, left, right) == []


@pytest.mark.parametrize(
    ("ratio", "stretches"),
    [
        (0.8, (1.03,)),
        (1.25, (1.02, 1.04, 1.07)),
        pytest.param(0.8, (1.02, 1.04, 1.07), marks=pytest.mark.long),
        pytest.param(1.25, (1.03,), marks=pytest.mark.long),
    ],
)
def test_a_recording_with_forces_calibrates_the_sheet(
    ratio: float, stretches: tuple[float, ...]
) -> None:
    apparatus = Apparatus(scene=SCENE.name, sheet=SheetTruth(modulus_ratio=ratio))
    pushes = Recorded(apparatus, stretches).pushes()
    calibration = make_calibration(
        SCENE,
        pushes,
        list(range(len(pushes))),
        source="test",
        with_mooney=False,
        with_table=False,
        with_prior=True,
    )
    fitted = calibration.modulus_thickness_n_per_m
    assert fitted.value == pytest.approx(ratio * EXPECTED, rel=0.05)
    assert abs(fitted.value - ratio * EXPECTED) < 3.0 * fitted.standard_deviation


def write_bag(path: Path, recorded: Recorded, *, with_force: bool = True) -> Path:
    """Write the poses and forces to a bag, as in a graph with a gauge."""
    with BagWriter(path, {"recording": {"clock_id": "clock", "started_ns": "1"}}) as writer:

        def write(topic: str, message: Message, at_ns: int) -> None:
            header = Header(1, at_ns, at_ns, "clock", "n", 1)
            writer.write(TOPICS[topic], message, header, at_ns)

        write("scene", SCENE, 1)
        rows = zip(recorded.times, recorded.tips, recorded.left, recorded.right, strict=True)
        for at_ns, tip, left, right in rows:
            write("fingertip", fingertip(tip), at_ns)
            write("arm_left", arm_state("left", world_from_flange=left.reshape(4, 4)), at_ns)
            write("arm_right", arm_state("right", world_from_flange=right.reshape(4, 4)), at_ns)
        for at_ns, newtons in recorded.forces if with_force else ():
            write("force", force(newtons), at_ns)
            write("force", force(99.0, valid=False), at_ns)
    return path


def test_calibrate_sheet_reads_a_bag(tmp_path: Path) -> None:
    apparatus = Apparatus(scene=SCENE.name, sheet=SheetTruth(modulus_ratio=0.8))
    bag = write_bag(tmp_path / "pushes.mcap", Recorded(apparatus))
    output = tmp_path / "sheet.yaml"
    command = ["calibrate", "sheet", "--bag", str(bag), "-o", str(output), "--json"]
    outcome = CliRunner().invoke(app, command)
    assert outcome.exit_code == 0, outcome.output
    found = json.loads(outcome.stdout)["modulus_thickness_n_per_m"]["value"]
    assert found == pytest.approx(0.8 * EXPECTED, rel=0.05)
    calibration = SheetCalibration.load(output)
    assert make_force_model(SHEET, calibration) is not None
    (check,) = check_stiffness(SHEET, calibration)
    assert check.suspected


def test_a_bag_without_forces_is_refused(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "pushes.mcap", Recorded(None), with_force=False)
    with pytest.raises(SheetModelFitError, match="no valid messages of the topics force; record"):
        read_pushes(bag)
