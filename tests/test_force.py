"""Test measured forces: gauge, simulated gauge, calibration and self-check."""

from __future__ import annotations

import asyncio
import json
import os
from collections.abc import Iterator
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
from flexsheet.launch.experiments.compliance import RestInterval, _measure_n
from flexsheet.launch.experiments.stroke import SampledMotion
from flexsheet.launch.plans.plan import load_graph
from flexsheet.messages.apparatus import Apparatus, GaugeTruth, SheetTruth
from flexsheet.messages.bag import BagWriter
from flexsheet.messages.base import Header, Message
from flexsheet.messages.clock import SystemClock
from flexsheet.messages.sheet_calibration import load_sheet_calibration
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import Force, SheetTarget, TwinArms, TwinFinger
from flexsheet.nodes.gauge.node import Gauge, GaugeParameters, SerialSource
from flexsheet.nodes.gauge.serial_gauge import GaugeError, SerialGauge, parse_line
from flexsheet.nodes.models.rigid import inverse, transform, transform_from_rpy
from flexsheet.nodes.models.sheet.force_models import SheetPush
from flexsheet.nodes.planner.node import Planner
from flexsheet.nodes.planner.parameters import PlannerParameters
from flexsheet.nodes.planner.self_checks import MeasuredForceCheck, PlannedPush, check_stiffness
from flexsheet.nodes.planner.sheet_force import make_force_model
from flexsheet.nodes.twin.gauge_node import TrueSheetForce, TwinGauge, TwinGaugeParameters
from flexsheet.nodes.twin.tolerance_table import sample_apparatus
from tests.arm_states import arm_state
from tests.examples import long_except
from tests.fingertips import fingertip
from tests.node_harness import NodeHarness, build_node
from tests.test_planner import SCENE
from tests.waiting import until

Floats = NDArray[np.float64]
SHEET = SCENE.sheet
EXPECTED = SHEET.young_modulus_pa * SHEET.thickness_m


def force(newtons: float, *, valid: bool = True) -> Force:
    return Force(
        source="gauge",
        axis="sheet_normal",
        valid=valid,
        reason="ok" if valid else "overload",
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


@pytest.mark.parametrize(
    ("line", "value"),
    [
        (b"+0.123 N", 0.123),
        (b"  -4.5", -4.5),
        (b"ST,GS,  1.2e-1kg", 0.12),
        (b".5", 0.5),
        (b"no load", None),
        (b"1e999", None),
        (b"", None),
    ],
)
def test_a_line_gives_its_first_number(line: bytes, value: float | None) -> None:
    assert parse_line(line) == value


@pytest.fixture
def port() -> Iterator[tuple[int, str]]:
    """Yield the file descriptor of a simulated serial device, and the path of its port."""
    device, end = os.openpty()
    yield device, os.ttyname(end)
    for fd in (device, end):
        os.close(fd)


def test_a_serial_gauge_reads_lines_in_pieces(port: tuple[int, str]) -> None:
    device, path = port
    gauge = SerialGauge(path, 9600)
    assert gauge.read() == []
    os.write(device, b"0.10 N\r\n0.2")
    assert gauge.read() == [0.1]
    os.write(device, b"0 N\r\nERR\r\n0.30 N\r\n")
    assert gauge.read() == [0.2, 0.3]
    assert gauge.unreadable == 1
    gauge.close()


@pytest.mark.parametrize(
    ("path", "baud", "text"),
    [
        ("/dev/none", 9600, "/dev/none: cannot be opened as a serial port: No such file"),
        ("/dev/null", 9600, "/dev/null: cannot be opened as a serial port"),
        ("/dev/null", 9601, "baud rate 9601 is not supported"),
    ],
)
def test_a_port_that_is_no_gauge_is_refused(path: str, baud: int, text: str) -> None:
    with pytest.raises(GaugeError, match=text):
        SerialGauge(path, baud)


def test_the_gauge_node_publishes_readings_silence_and_overload(port: tuple[int, str]) -> None:
    device, path = port
    given = GaugeParameters(
        source=SerialSource(port=path),
        newtons_per_unit=-2.0,
        zero_units=0.1,
        delay_s=0.03,
        max_force_n=5.0,
        silence_s=1e-6,
    )

    async def run() -> list[tuple[Force, float]]:
        clock = SystemClock()
        harness = NodeHarness(Gauge, given, clock)
        await harness.node.setup()
        harness.node.watch()
        before_ns = clock.now_ns()
        os.write(device, b"-0.9 N\r\n-9 N\r\n")
        await until(lambda: len(harness.published) >= 3)
        await harness.node.close()
        found = harness.messages(Force)
        return [(one, 1e-9 * (header.source_ns - before_ns)) for one, header in found]

    (silent, _), (good, age_s), (high, _) = asyncio.run(run())
    assert (silent.valid, silent.reason) == (False, "no_reading")
    assert (good.valid, good.reason, good.force_n) == (True, "ok", pytest.approx(2.0))
    assert age_s >= -0.03
    assert (high.valid, high.reason) == (False, "overload")


def test_a_gauge_that_is_absent_is_reported_once_and_opened_later(port: tuple[int, str]) -> None:
    _, path = port
    link = Path(path)

    async def run() -> None:
        harness = NodeHarness(
            Gauge, GaugeParameters(source=SerialSource(port="/dev/none")), SystemClock()
        )
        node = harness.node
        await node.setup()
        node.watch()
        assert node.errors == 1
        assert "/dev/none" in node.note
        node.parameters = GaugeParameters(source=SerialSource(port=str(link)))
        node.watch()
        assert node._reader is not None
        await node.close()

    asyncio.run(run())


def run_twin_gauge(apparatus: Apparatus | None, depths_m: list[float]) -> list[tuple[Force, int]]:
    """Return the readings of the simulated gauge at given depths, with their timestamps."""

    async def run() -> list[tuple[Force, int]]:
        harness = build_node(TwinGauge, TwinGaugeParameters(apparatus=apparatus))
        await harness.node.setup()
        await harness.step("scene", SCENE)
        left, right = flanges(1.05)
        stamps = []
        for depth_m in depths_m:
            harness.clock.move_to(harness.clock.now_ns() + 1_000_000_000)
            await harness.step(
                "twin__arms",
                TwinArms(
                    joints_left_rad=np.zeros(6),
                    joints_right_rad=np.zeros(6),
                    world_from_flange_left=left,
                    world_from_flange_right=right,
                ),
            )
            await harness.step(
                "twin__finger",
                TwinFinger(
                    path_label="",
                    path_done=False,
                    path_time_s=0.0,
                    position_world_m=np.array([0.0, 0.0, -depth_m]),
                    velocity_world_m_per_s=np.zeros(3),
                ),
            )
            stamps.append(harness.clock.now_ns())
            await harness.node.measure()
        found = harness.messages(Force)
        return [
            (one, header.source_ns - stamp)
            for (one, header), stamp in zip(found, stamps, strict=True)
        ]

    return asyncio.run(run())


def test_the_simulated_gauge_has_the_errors_of_the_apparatus() -> None:
    (rest, _), (pushed, lag_ns) = run_twin_gauge(None, [-0.01, 0.02])
    assert rest.force_n == 0.0
    assert lag_ns == 0
    model = make_force_model(SHEET)
    predicted = model.evaluate(SheetPush(1.05, 0.007), np.array([0.02]))
    assert pushed.force_n == pytest.approx(float(predicted.force_n[0]), rel=0.05)
    truth = GaugeTruth(noise_n=0.0, offset_n=0.1, gain_ratio=1.1, lag_s=0.05)
    wrong = Apparatus(scene=SCENE.name, gauge=truth)
    (rest, _), (more, lag_ns) = run_twin_gauge(wrong, [-0.01, 0.02])
    assert rest.force_n == pytest.approx(0.1)
    assert more.force_n == pytest.approx(1.1 * pushed.force_n + 0.1)
    assert lag_ns == 50_000_000
    noisy = Apparatus(scene=SCENE.name, gauge=GaugeTruth(noise_n=0.01))
    readings = [one.force_n for one, _ in run_twin_gauge(noisy, [-0.01] * 200)]
    assert np.std(readings) == pytest.approx(0.01, rel=0.2)


def test_the_simulated_gauge_measures_the_true_sheet() -> None:
    soft = Apparatus(scene=SCENE.name, sheet=SheetTruth(modulus_ratio=0.8))
    (nominal, _), (softer, _) = (run_twin_gauge(one, [0.02])[0] for one in (None, soft))
    assert softer.force_n / nominal.force_n == pytest.approx(0.8, rel=0.01)


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
        truth = TrueSheetForce(SCENE, self.apparatus)
        random = np.random.default_rng(4)
        now_ns = 10**9
        for stretch_ratio in self.stretches:
            left, right = flanges(stretch_ratio)
            for depth_m in (-0.01, 0.006, 0.012, 0.02, 0.03, 0.015, 0.008):
                tip = np.array([0.01, 0.005, -depth_m])
                newtons = truth.compute_n(1e-9 * now_ns, tip, left, right)
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
    calibration = load_sheet_calibration(output)
    assert make_force_model(SHEET, calibration) is not None
    (check,) = check_stiffness(SHEET, calibration)
    assert check.suspected


def test_a_bag_without_forces_is_refused(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "pushes.mcap", Recorded(None), with_force=False)
    with pytest.raises(SheetModelFitError, match="no valid messages of the topics force; record"):
        read_pushes(bag)


def compare(apparatus: Apparatus | None, depths_m: tuple[float, ...]) -> MeasuredForceCheck:
    """Run the self-check with the true force of a simulated sheet at constant depths."""
    check = MeasuredForceCheck(SCENE, make_force_model(SHEET))
    truth = TrueSheetForce(SCENE, apparatus)
    left, right = flanges(1.05)
    now_ns = 10**9
    for depth_m in depths_m:
        tip = np.array([0.0, 0.0, -depth_m])
        newtons = truth.compute_n(1e-9 * now_ns, tip, left, right)
        for step in range(60):
            at_ns = now_ns + step * 16_666_667
            check.add_push(PlannedPush(at_ns, 1.05, depth_m, (0.0, 0.0)))
            if step % 15 == 0:
                check.add_force(force(newtons), at_ns - 30_000_000)
                check.add_force(force(50.0, valid=False), at_ns - 30_000_000)
        now_ns += 10**9
    return check


DEPTHS = (0.01, 0.02, 0.03, 0.02, 0.01)


@pytest.mark.parametrize(
    ("key", "ratio"),
    long_except(
        [(key, ratio) for key in ("modulus_ratio", "thickness_ratio") for ratio in (0.8, 1.2)],
        *(("modulus_ratio", 0.8), ("thickness_ratio", 1.2)),
    ),
)
def test_a_wrong_modulus_or_thickness_is_named_by_the_measured_force(
    key: str, ratio: float
) -> None:
    sheet = SheetTruth.model_validate({key: ratio})
    (found,) = compare(Apparatus(scene=SCENE.name, sheet=sheet), DEPTHS).result
    assert (found.cause, found.suspected) == ("sheet_stiffness", True)
    assert found.value == pytest.approx(ratio * EXPECTED, rel=0.06)


@pytest.mark.parametrize(
    "seed", [120, *(pytest.param(seed, marks=pytest.mark.long) for seed in (121, 122, 123))]
)
def test_a_calibrated_sheet_is_not_suspected(seed: int) -> None:
    drawn = sample_apparatus(SCENE, seed, calibrated=True)
    only_sheet = Apparatus(scene=SCENE.name, sheet=drawn.sheet)
    (found,) = compare(only_sheet, DEPTHS).result
    assert not found.suspected, found


def test_small_and_moving_pushes_are_not_compared() -> None:
    soft = Apparatus(scene=SCENE.name, sheet=SheetTruth(modulus_ratio=0.5))
    assert compare(soft, (0.003, 0.004)).result == ()
    check = MeasuredForceCheck(SCENE, make_force_model(SHEET))
    for step in range(400):
        at_ns = step * 16_666_667
        check.add_push(PlannedPush(at_ns, 1.05, 0.01 + 5e-5 * step, (0.0, 0.0)))
        check.add_force(force(9.0), at_ns)
    assert check.result == ()


def test_the_planner_checks_the_force_only_if_a_gauge_is_in_the_graph() -> None:
    async def run(with_gauge: bool) -> Planner:
        harness = build_node(Planner, PlannerParameters(compliance_mode="constant_stretch"))
        await harness.node.setup()
        await harness.step("scene", SCENE)
        at = np.array([0.0, 0.0, 0.05])
        for step in range(400):
            harness.clock.move_to(harness.clock.now_ns() + 16_666_667)
            at = np.array([0.0, 0.0, max(0.05 - 5e-4 * step, -0.012)])
            await harness.step("fingertip", fingertip(at), sequence=step + 1)
            if with_gauge and step % 10 == 0:
                await harness.step("force", force(30.0), sequence=step + 1)
        targets = harness.messages(SheetTarget)
        assert targets[-1][0].push_depth_m == pytest.approx(0.012, abs=1e-3)
        return harness.node

    (found,) = asyncio.run(run(True)).self_checks
    assert (found.cause, found.subject, found.suspected) == (
        "sheet_stiffness",
        "measured force",
        True,
    )
    assert asyncio.run(run(False)).self_checks == ()


def test_the_measured_force_of_a_rest_is_averaged() -> None:
    hold = RestInterval(0.01, 4.7, 5.0)
    forces = np.array([[4.3e9, 9.0], [4.6e9, 1.0], [4.9e9, 2.0], [5.1e9, 9.0]])
    assert _measure_n(forces, 0, hold) == pytest.approx(1.5)
    assert _measure_n(forces[:1], 0, hold) is None


def test_only_the_launch_file_with_a_gauge_has_forces() -> None:
    folder = Path(__file__).parent.parent / "launch"
    assert "force" not in load_graph(folder / "demo.yaml").writers
    assert [writer.name for writer in load_graph(folder / "force.yaml").writers["force"]] == [
        "twin_gauge"
    ]
