"""Test the simulated hand: its motion, its sheet, its node, and its loop with the real nodes."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import curve_fit

from flexsheet.launch.experiments.driver import Driver
from flexsheet.launch.experiments.ports import choose_ports
from flexsheet.launch.experiments.run import run_experiment
from flexsheet.launch.experiments.simulated_time import (
    COMPUTING_S,
    CYCLE_S,
    READ_OUT_S,
    SENDING_S,
    SERVO_LAG_S,
    SETTLING_S,
    LoopSettings,
    SimulatedSheet,
    TouchRecording,
    make_soft_body,
    touch_in_simulated_time,
)
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.apparatus import Apparatus, nominal_apparatus
from flexsheet.messages.bag import BagReader
from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import (
    ArmLatency,
    FingerPath,
    Fingertip,
    SheetTarget,
    SoftBody,
    TwinArms,
    TwinFinger,
)
from flexsheet.nodes.models.motion import SheetMotion
from flexsheet.nodes.models.rigid import inverse, pose_matrix, transform
from flexsheet.nodes.planner import hand_bounds
from flexsheet.nodes.planner.node import Planner
from flexsheet.nodes.planner.parameters import PlannerParameters
from flexsheet.nodes.planner.trajectory import SheetTrajectoryPlanner
from flexsheet.nodes.triangulator.node import Triangulator
from flexsheet.nodes.triangulator.parameters import TriangulatorParameters
from flexsheet.nodes.twin import finger_node
from flexsheet.nodes.twin.finger_node import TwinFingerNode, TwinFingerParameters
from flexsheet.nodes.twin.hand import (
    CoupledFinger,
    EdgeTrack,
    HandImpedance,
    Touch,
    TrueSheet,
)
from flexsheet.nodes.twin.membrane import TrueRubber, solve
from flexsheet.nodes.twin.sheet_reaction import (
    POSITION_FRACTIONS,
    SheetReaction,
    load_or_compute_reaction,
)
from tests.hand_bounds import make_bounds_60_hz
from tests.node_harness import NodeHarness

Floats = NDArray[np.float64]
LAUNCH = Path(__file__).parent.parent / "launch"
DEMO = LAUNCH / "demo.yaml"
SCENE = load_scene(LAUNCH / "scenes" / "cylinder.yaml")
STIFFNESS_N_PER_M = 60.0
PUSH_M = 0.01
PUSHED_S = 0.32
"""Time on the path at which a push has ended, and the oscillation is free."""

CURVE = np.array([[0.0, 0.0], [0.025, 1.0], [0.05, 2.0]])
"""Force of an object of 40 N/m over depth."""

HANDS = (
    HandImpedance(0.006, 80.0, 0.58),
    HandImpedance(0.15, 100.0, 0.18),
    HandImpedance(1.0, 600.0, 0.31),
)
"""A finger, a wrist and an arm, of low damping."""

SLOW_HANDS = (HANDS[1], HandImpedance(0.12, 200.0, 0.25), HandImpedance(1.0, 300.0, 0.2))
"""Two wrists and an arm that oscillate so slowly that the camera samples the oscillation."""


def make_linear_reaction() -> SheetReaction:
    """Return the reaction of a sheet with the same stiffness at all positions and stretches."""
    depths = np.linspace(0.0, 0.05, 51)
    nodes = len(POSITION_FRACTIONS)
    return SheetReaction(
        np.array([SCENE.sheet.width_m]),
        np.array([SCENE.sheet.height_m]),
        np.array([1.0, 1.05, 1.1]),
        depths,
        np.tile(STIFFNESS_N_PER_M * depths, (3, 1)),
        np.ones((nodes, nodes, len(depths))),
    )


class FixedSheet(TrueSheet):
    """Flat linear sheet at z = 0, wherever its edges are."""

    def __init__(self) -> None:
        self.step_m, self.history = 0.001, None
        self._curve_n = STIFFNESS_N_PER_M * self.step_m * np.arange(60)

    def find_touch(self, edges: tuple[Floats, Floats], tip: Floats) -> Touch:
        return Touch(np.zeros(3), np.array([0.0, 0.0, 1.0]), self._curve_n)


def still(_: float) -> tuple[Floats, Floats]:
    return np.array([0.0, 0.0, -PUSH_M]), np.zeros(3)


def fixed_edges(_: float) -> tuple[Floats, Floats]:
    return np.eye(4), np.eye(4)


@pytest.mark.parametrize("hand", HANDS)
def test_a_hand_on_a_fixed_sheet_moves_as_the_linear_equation_says(hand: HandImpedance) -> None:
    finger = CoupledFinger(hand, FixedSheet(), still)
    finger.log = []
    finger.advance(1.0, fixed_edges)
    times, indented, forces = np.array(finger.log).T
    k, m = hand.stiffness_n_per_m, hand.mass_kg
    decay = hand.damping_ratio * math.sqrt(k / m)
    pace = math.sqrt((k + STIFFNESS_N_PER_M) / m - decay**2)
    rest = PUSH_M * STIFFNESS_N_PER_M / (k + STIFFNESS_N_PER_M)
    free = np.exp(-decay * times) * (np.cos(pace * times) + decay / pace * np.sin(pace * times))
    np.testing.assert_allclose(PUSH_M - indented, rest * (1.0 - free), atol=2e-5)
    np.testing.assert_allclose(forces, STIFFNESS_N_PER_M * np.maximum(indented, 0.0))


def test_the_integration_neither_adds_nor_removes_energy() -> None:
    finger = CoupledFinger(HandImpedance(0.005, 50.0, 0.0), FixedSheet(), still)
    finger.log = []
    finger.advance(3.0, fixed_edges)
    times, indented, _ = np.array(finger.log).T
    early, late = (np.ptp(indented[part]) for part in (times < 0.2, times > 2.8))
    assert late == pytest.approx(early, rel=0.01)


def test_a_prediction_leaves_the_finger_where_it_is() -> None:
    finger = CoupledFinger(HANDS[1], FixedSheet(), still)
    finger.advance(0.05, fixed_edges)
    before = finger.deviation_m.copy()
    ahead = finger.predict(0.09, fixed_edges)
    assert np.array_equal(finger.deviation_m, before)
    finger.advance(0.09, fixed_edges)
    np.testing.assert_allclose(ahead.deviation_m, finger.deviation_m, atol=1e-9)


def test_a_finger_in_front_of_the_sheet_follows_its_path_exactly() -> None:
    finger = CoupledFinger(
        HANDS[0], FixedSheet(), lambda at: (np.array([0, 0, 0.001]), np.zeros(3))
    )
    finger.advance(0.5, fixed_edges)
    assert not finger.deviation_m.any()
    assert not finger.force_n.any()


def test_the_impedance_is_that_of_the_apparatus() -> None:
    finger = {"hand_mass_kg": 0.5, "hand_damping_ratio": 0.2, "hand_stiffness_n_per_m": 300.0}
    apparatus = Apparatus.model_validate({"scene": "cylinder", "finger": finger})
    assert HandImpedance.of(apparatus) == HandImpedance(0.5, 300.0, 0.2)
    assert HandImpedance.of(None) == HandImpedance.of(nominal_apparatus(SCENE)) == HandImpedance()


def place_edges(z_m: float = 0.0) -> tuple[Floats, Floats]:
    half = 0.5 * 1.05 * SCENE.sheet.width_m
    left, right = (transform(np.eye(3), [side * half, 0.0, z_m]) for side in (-1.0, 1.0))
    return left, right


def test_the_sheet_sags_and_ends_at_its_free_edges() -> None:
    sheet = TrueSheet(SCENE, None, make_linear_reaction())
    flat = sheet.find_touch(place_edges(), np.array([0.0, 0.0, -0.01]))
    assert flat.origin[2] == pytest.approx(0.0, abs=1e-6)
    assert flat.curve_n[20] == pytest.approx(STIFFNESS_N_PER_M * 0.02)
    # Tilted by 60 degrees about x, the sheet hangs below the plane through its edges.
    cosine, sine = 0.5, math.sqrt(0.75)
    tilt = transform(np.array([[1, 0, 0], [0, cosine, sine], [0, -sine, cosine]]), np.zeros(3))
    left, right = (tilt @ edge for edge in place_edges())
    tilted = sheet.find_touch((left, right), -0.01 * tilt[:3, 2])
    assert -0.003 < float(tilted.origin @ tilted.normal) < -0.0005
    for beside in ([0.0, 0.13, -0.01], [0.14, 0.0, -0.01]):
        assert not sheet.find_touch(place_edges(), np.array(beside)).curve_n.any()


def test_edges_are_extrapolated_for_a_short_time_only() -> None:
    track = EdgeTrack()
    track.add(0.0, *place_edges(0.0))
    assert not track
    track.add(0.01, *place_edges(0.001))
    assert [track(at)[0][2, 3] for at in (0.005, 0.02, 9.0)] == pytest.approx([5e-4, 2e-3, 3e-3])


@pytest.mark.long
def test_the_table_of_the_sheet_is_the_membranes_force(tmp_path: Path) -> None:
    reaction = load_or_compute_reaction(SCENE, None, tmp_path)
    spec = SCENE.sheet
    rubber = TrueRubber(spec.width_m, spec.height_m, spec.thickness_m, spec.young_modulus_pa)
    for stretch, x_m, y_m in ((1.03, 0.0, 0.0), (1.06, 0.02, 0.03), (1.06, 0.0, 0.05)):
        half = 0.5 * stretch * spec.width_m
        edges = [transform(np.eye(3), [side * half, 0.0, 0.0]) for side in (-1.0, 1.0)]
        curve = reaction.curve_n(2.0 * half, x_m, y_m)
        for depth in (0.004, 0.011, 0.03):
            pushed = solve(
                rubber,
                *edges,
                finger_tip=np.array([x_m, y_m, -depth]),
                finger_radius_m=SCENE.finger.radius_m,
            )
            found = np.interp(depth, reaction.depths_m, curve)
            assert found == pytest.approx(float(pushed.finger_force_n[2]), rel=0.08)


def make_push(depth_m: float, seconds: float) -> FingerPath:
    """Return a quick push at the front of the object, which is then held."""
    heights = np.array([0.01, -depth_m, -depth_m])
    return FingerPath(
        label="push",
        times_s=np.array([0.0, 0.25, seconds]),
        positions_world_m=np.column_stack([0.0 * heights, 0.0 * heights, heights]),
        wander_m=0.0,
        tremor_m=0.0,
    )


def make_apparatus(hand: HandImpedance) -> Apparatus:
    return Apparatus.model_validate(
        {
            "scene": "cylinder",
            "finger": {
                "hand_mass_kg": hand.mass_kg,
                "hand_damping_ratio": hand.damping_ratio,
                "hand_stiffness_n_per_m": hand.stiffness_n_per_m,
            },
        }
    )


@dataclass(frozen=True, slots=True)
class Response:
    """Response of a hand to a push: forces (N), frequency (Hz) and decay rate (1/s)."""

    steady_n: float
    steady_m: float
    peak_n: float
    frequency_hz: float
    decay_per_s: float


def measure_response(
    hand: HandImpedance, depths: tuple[Floats, Floats], forces: tuple[Floats, Floats]
) -> Response:
    """Fit a decaying oscillation to the depth after the push, and return its parameters.

    A cubic polynomial is fitted with it, because the sheet's offset continues to change slowly.
    depths, forces: times (n,) on the path, s, and values (n,) in m and N, until the steady state.
    """
    after = depths[0] > PUSHED_S
    times, depth_m = depths[0][after] - PUSHED_S, depths[1][after]

    def oscillation(t: Floats, *given: float) -> Floats:
        size, decay, hz, phase, *drift = given
        wave = size * np.exp(-decay * t) * np.cos(2.0 * np.pi * hz * t + phase)
        return np.asarray(wave + np.polyval(drift, t))

    pace = math.sqrt((hand.stiffness_n_per_m + STIFFNESS_N_PER_M) / hand.mass_kg)
    decay = hand.damping_ratio * math.sqrt(hand.stiffness_n_per_m / hand.mass_kg)
    start = (1e-3, decay, pace / (2.0 * np.pi), 0.0, 0.0, 0.0, 0.0, float(depth_m[-1]))
    (_, decay, hz, _, *drift), _ = curve_fit(
        oscillation, times, depth_m, start, x_scale=[1e-3, 1.0, 1.0, 1.0, *4 * [1e-3]],
        method="trf",
    )  # fmt: skip
    rest_m = np.polyval(drift, times[-1])
    steady = forces[0] > forces[0][-1] - 0.2
    return Response(
        float(forces[1][steady].mean()), float(rest_m), float(forces[1].max()), float(hz),
        float(decay),
    )  # fmt: skip


class NodeLoop:
    """Nodes of finger, triangulator and planner, and simulated arms, in simulated time.

    Only the transport, the bridges' network and the load of a computer are missing.
    """

    def __init__(self, hand: HandImpedance, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(
            finger_node, "load_or_compute_reaction", lambda *_: make_linear_reaction()
        )
        monkeypatch.setattr(
            "flexsheet.nodes.planner.node.load_or_compute_bounds", lambda *_: make_bounds_60_hz()
        )
        self.hand, self.clock = hand, VirtualClock(10**9, clock_id="clock")
        self.apparatus = make_apparatus(hand)
        parameters = TwinFingerParameters(hand="coupled", apparatus=self.apparatus, clutter="none")
        self.finger = NodeHarness(TwinFingerNode, parameters, self.clock)
        calibration = LAUNCH / "calibrations" / "twin-bumblebee.yaml"
        self.eyes = NodeHarness(
            Triangulator, TriangulatorParameters(calibration=calibration), self.clock
        )
        self.planner = NodeHarness(Planner, PlannerParameters(), self.clock)
        home = SheetTrajectoryPlanner(SCENE, PlannerParameters()).motion
        self.sheet = SimulatedSheet(SCENE, self.apparatus, home, LoopSettings())
        self.sheet.on_edges = self.publish_arms
        self.arms: list[TwinArms] = []
        self.target, self.valid_at_s, self.commanded_s = home, 0.0, 0.0
        specs = SCENE.arms.left, SCENE.arms.right
        self.edge_from_flange = [inverse(pose_matrix(arm.flange_from_edge)) for arm in specs]

    def publish_arms(self, now_s: float, left: Floats, right: Floats) -> None:
        flanges = [
            edge @ from_edge
            for edge, from_edge in zip((left, right), self.edge_from_flange, strict=True)
        ]
        self.arms.append(TwinArms(
            joints_left_rad=np.zeros(6), joints_right_rad=np.zeros(6),
            world_from_flange_left=flanges[0], world_from_flange_right=flanges[1],
        ))  # fmt: skip

    def move_to(self, at_s: float) -> None:
        self.clock.move_to(10**9 + round(1e9 * at_s))

    async def run_cycle(self, now_s: float) -> None:
        self.sheet.record(now_s)
        self.move_to(now_s)
        await self.finger.step("twin__arms", self.arms[-1])
        for arm in self.sheet.arms:
            arm.command(self.target, self.valid_at_s, now_s, now_s - self.commanded_s)
        self.commanded_s = now_s

    async def run_cycles(self, until_s: float) -> None:
        while self.commanded_s + CYCLE_S < until_s:
            await self.run_cycle(self.commanded_s + CYCLE_S)

    async def run(self, path: FingerPath, seconds: float) -> Response:
        """Let the finger push along a path, after the sheet has settled for a second."""
        await self.eyes.node.setup()
        await self.planner.node.setup()
        for one in (self.finger, self.eyes, self.planner):
            await one.step("scene", SCENE)
        await self.planner.step("soft_body", make_soft_body(CURVE))
        assert self.finger.node.preparing is not None
        await self.finger.node.preparing
        period_s, exposure_s = 1.0 / SCENE.camera.rate_hz, SCENE.camera.exposure_s
        age_s = 0.5 * exposure_s + READ_OUT_S + COMPUTING_S
        begun = False
        coupled = self.finger.node.coupled
        assert coupled is not None
        coupled.log = []
        for number in range(1, int((1.0 + seconds) / period_s)):
            exposed_s = number * period_s
            await self.run_cycles(exposed_s)
            self.move_to(exposed_s)
            if exposed_s > 1.0 and not begun:
                begun = True
                await self.finger.step("twin__finger_path", path)
            pair = self.finger.node.expose(self.clock.now_ns())
            await self.run_cycles(exposed_s + age_s)
            self.move_to(exposed_s + age_s)
            await self.eyes.step("stereo", pair, age_ms=1e3 * age_s)
            fingertip, _ = self.eyes.messages(Fingertip)[-1]
            await self.planner.step("fingertip", fingertip, age_ms=1e3 * age_s)
            await self.run_cycle(exposed_s + age_s + SENDING_S)
            target, _ = self.planner.messages(SheetTarget)[-1]
            self.target = SheetMotion(
                target.world_from_sheet, target.twist_world, target.stretch_ratio, 0.0
            )
            self.valid_at_s = 1e-9 * (target.valid_at_ns - 10**9)
            if number % 12 == 0:
                for arm, side in zip(self.sheet.arms, ("left", "right"), strict=True):
                    latency = ArmLatency(side=side, latency_s=age_s + SENDING_S + arm.lag_s)
                    await self.planner.step("arm_latency", latency)
        truths = [message for message, _ in self.finger.messages(TwinFinger)]
        depths = np.array([(one.path_time_s, -one.position_world_m[2]) for one in truths])
        log = np.array(coupled.log)
        return measure_response(self.hand, tuple(depths[-80:].T), (log[:, 0], log[:, 2]))


def measure_recorded(hand: HandImpedance, recorded: TouchRecording, path: FingerPath) -> Response:
    """Return the response in a simulated run, until 0.1 s before the end of the path."""
    end_s = path.times_s[-1] - 0.1
    times, steps = recorded.times_s - SETTLING_S, recorded.steps - [SETTLING_S, 0.0, 0.0]
    steps = steps[steps[:, 0] < end_s]
    seen = times < end_s
    depths_m = -recorded.positions_m[seen, 2]
    return measure_response(hand, (times[seen], depths_m), (steps[:, 0], steps[:, 2]))


def simulate_push(hand: HandImpedance, path: FingerPath) -> Response:
    """Simulate the same push without nodes."""
    recorded = touch_in_simulated_time(
        SCENE,
        path,
        CURVE,
        lambda voluntary: CoupledFinger(
            hand, TrueSheet(SCENE, None, make_linear_reaction()), voluntary
        ),
        bounds=make_bounds_60_hz(),
    )
    return measure_recorded(hand, recorded, path)


def assert_agree(one: Response, other: Response) -> None:
    """Assert that two responses agree within 10 %, the decay rate within 0.5 /s."""
    assert one.steady_n == pytest.approx(other.steady_n, rel=0.1)
    assert one.steady_m == pytest.approx(other.steady_m, rel=0.1)
    assert one.peak_n == pytest.approx(other.peak_n, rel=0.1)
    assert one.frequency_hz == pytest.approx(other.frequency_hz, rel=0.1)
    assert one.decay_per_s == pytest.approx(other.decay_per_s, rel=0.1, abs=0.5)


async def test_the_nodes_and_the_simulation_without_nodes_agree(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = make_push(PUSH_M, 1.2)
    alone = simulate_push(HANDS[1], path)
    loop = NodeLoop(HANDS[1], monkeypatch)
    assert_agree(await loop.run(path, 1.4), alone)


@dataclass(frozen=True, slots=True)
class GraphRun:
    """Push in a running graph: motion and force of the finger, force curve of the object, delay."""

    times_s: Floats
    depths_m: Floats
    forces_n: Floats
    curve: Floats
    delay_s: float


def push_in_graph(hand: HandImpedance, path: FingerPath, folder: Path) -> GraphRun:
    apparatus = folder / "hand.yaml"
    apparatus.write_text(json.dumps(make_apparatus(hand).model_dump(mode="json")))

    hover = path.model_copy(
        update={
            "label": "hover",
            "times_s": np.array([0.0, 3.0]),
            "positions_world_m": path.positions_world_m[[0, 0]],
        }
    )

    async def procedure(driver: Driver, _: Scene) -> None:
        # Meanwhile the arms stretch the sheet for the object.
        await driver.follow(hover)
        await driver.follow(path)

    bag = folder / "push.mcap"
    scene = folder / "scene.yaml"
    scene.write_text(SCENE.model_copy(update={"projector": None}).model_dump_json())
    settings = [*choose_ports(DEMO), "twin_finger.hand=coupled", f"scene={scene}"]
    run_experiment(DEMO, settings, bag, procedure, print, apparatus=str(apparatus))
    return read_push(path, bag)


def read_push(path: FingerPath, bag: Path) -> GraphRun:
    times, forces, depths, delays, curve = [], [], [], [], CURVE
    for _, message, header, _ in BagReader(
        bag, topics=["twin/finger", "sheet_target", "soft_body"]
    ):
        match message:
            case TwinFinger() if message.path_label == path.label and not message.path_done:
                times.append(message.path_time_s)
                forces.append(float(np.linalg.norm(message.force_world_n)))
                depths.append(-message.position_world_m[2])
            case SheetTarget() if message.phase == "contact":
                delays.append(1e-9 * (message.valid_at_ns - header.source_ns))
            case SoftBody() if len(message.force_curve):
                curve = message.force_curve
            case _:
                pass
    before = np.array(times) < path.times_s[-1] - 0.1
    at_s, depths_m, forces_n = (np.array(values)[before] for values in (times, depths, forces))
    return GraphRun(at_s, depths_m, forces_n, curve, float(np.median(delays)))


@pytest.mark.long
@pytest.mark.parametrize("hand", SLOW_HANDS)
def test_the_running_graph_and_the_simulation_agree(hand: HandImpedance, tmp_path: Path) -> None:
    """Compare the motions, because a fit of a well-damped oscillation is ill-conditioned."""
    path = make_push(PUSH_M, 2.5)
    graph = push_in_graph(hand, path, tmp_path)
    fixed_s = 0.5 * SCENE.camera.exposure_s + READ_OUT_S + SENDING_S + SERVO_LAG_S
    reaction = load_or_compute_reaction(SCENE, None)
    recorded = touch_in_simulated_time(
        SCENE,
        path,
        graph.curve,
        lambda voluntary: CoupledFinger(hand, TrueSheet(SCENE, None, reaction), voluntary),
        bounds=make_bounds_60_hz(),
        settings=LoopSettings(computing_s=graph.delay_s - fixed_s),
    )
    assert recorded.delay_s == pytest.approx(graph.delay_s, abs=0.004)
    expected_m = np.interp(
        graph.times_s, recorded.times_s - SETTLING_S, -recorded.positions_m[:, 2]
    )
    assert np.abs(graph.depths_m - expected_m).max() < 0.1 * expected_m.max()
    expected = measure_recorded(hand, recorded, path)
    steady = graph.times_s > graph.times_s[-1] - 0.2
    assert graph.depths_m[steady].mean() == pytest.approx(expected.steady_m, rel=0.1)
    assert graph.forces_n[steady].mean() == pytest.approx(expected.steady_n, rel=0.1)
    assert graph.forces_n.max() == pytest.approx(expected.peak_n, rel=0.1)


def test_the_bounds_report_their_computation_only_if_it_is_needed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bounds = make_bounds_60_hz()
    monkeypatch.setattr(hand_bounds, "compute_offset_bounds", lambda *_, **__: bounds)
    reports: list[str] = []
    for _ in range(2):
        hand_bounds.load_or_compute_bounds(60.0, tmp_path, reports.append)
    assert len(reports) == 1
