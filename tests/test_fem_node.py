"""Test the soft-body node by the calls of the runner."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import AsyncIterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.messages.base import Header, Message
from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Fingertip, Skin, SoftBody
from flexsheet.nodes.fem_solver import precompute, snapshots, soft_body_factory
from flexsheet.nodes.fem_solver.body import SceneBody
from flexsheet.nodes.fem_solver.closest_contact import ContactQuery
from flexsheet.nodes.fem_solver.contact import Response
from flexsheet.nodes.fem_solver.mesh import cylinder
from flexsheet.nodes.fem_solver.node import BLEND_S, FemSolver
from flexsheet.nodes.fem_solver.parameters import FemSolverParameters
from flexsheet.nodes.fem_solver.soft_body_factory import SoftBodyFactory
from tests.fingertips import fingertip as even_fingertip
from tests.node_harness import NodeHarness
from tests.scenes import load_values
from tests.soft_bodies import InlineExecutor
from tests.waiting import DEADLINE_S

MAX_STEP_RATIO = 0.003
"""Maximum change of force and shape from one answer to the next at 60 Hz when a method replaces
another whose force is 20 % larger."""


def scene(**changes: Any) -> Scene:
    """Return the paper's scene with changes of its object."""
    content = load_values()
    content["object"].update(changes)
    return Scene.model_validate(content)


def header(source_ns: int = 0) -> Header:
    return Header(1, source_ns, source_ns, "virtual", "test", 0)


def fingertip(
    position: tuple[float, float, float],
    *,
    valid: bool = True,
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Fingertip:
    return even_fingertip(
        np.array(position, dtype=np.float64),
        np.array(velocity, dtype=np.float64),
        reason="ok" if valid else "no_marker",
    )


class Named:
    """A soft-body method under another name."""

    def __init__(self, method: Any, name: str) -> None:
        self._method, self.name = method, name

    def __getattr__(self, name: str) -> Any:
        return getattr(self._method, name)


class Bench(NodeHarness[FemSolver, VirtualClock]):
    """A soft-body node that receives fingertips from the test."""

    def __init__(self, **parameters: Any) -> None:
        given = FemSolverParameters(
            **{"skin_spacing_m": 0.007, "compute_table": False, **parameters}
        )
        super().__init__(FemSolver, given, VirtualClock(), name="fem_solver")

    @property
    def sent(self) -> list[tuple[str, Message, Header]]:
        return [(topic.name, message, header) for topic, message, header in self.published]

    async def push(self, tip: Fingertip, source_ns: int = 0) -> SoftBody:
        await self.node.step("fingertip", tip, header(source_ns))
        name, message, head = self.sent[-1]
        assert name == "soft_body"
        assert head.source_ns == source_ns
        assert isinstance(message, SoftBody)
        return message

    def skin(self) -> Skin:
        skins = [m for name, m, _ in self.sent if name == "skin"]
        assert isinstance(skins[-1], Skin)
        return skins[-1]


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(tmp_path_factory.mktemp("cache"))


@pytest.fixture
async def bench(cache: str) -> AsyncIterator[Bench]:
    bench = Bench(cache_dir=cache)
    await bench.node.setup()
    await bench.node.step("scene", scene(), header(5))
    yield bench
    await bench.node.close()
    assert bench.node.errors == 0, bench.node.last_error


async def test_nothing_is_published_before_a_scene(cache: str) -> None:
    bench = Bench(cache_dir=cache)
    await bench.node.setup()
    await bench.node.step("fingertip", fingertip((0, 0, 0)), header())
    assert bench.sent == []
    assert "scene" in bench.node.note


async def test_the_skin_has_the_pose_of_the_scene(bench: Bench) -> None:
    skin = bench.skin()
    assert bench.sent[0][2].source_ns == 5
    low, high = skin.vertices_world_m.min(axis=0), skin.vertices_world_m.max(axis=0)
    assert low == pytest.approx([-0.06, -0.0353553, -0.0707106], abs=2e-3)
    assert high == pytest.approx([0.06, 0.0353553, 0.0], abs=2e-3)
    assert bench.node.note.startswith("soft body by linear, force error up to ")


async def test_a_push_deforms_the_skin_towards_the_back(bench: Bench) -> None:
    answer = await bench.push(fingertip((0.0, 0.0, -0.004)), 17)
    assert answer.mesh_id == bench.skin().mesh_id
    assert answer.in_range
    assert answer.push_depth_m == pytest.approx(0.004, abs=1e-6)
    assert answer.displacement_world_m.shape == bench.skin().vertices_world_m.shape
    assert -0.0045 < answer.displacement_world_m[:, 2].min() < -0.0033
    assert answer.force_world_n[2] > 0.05  # the object pushes the finger back to the user
    assert np.abs(answer.force_world_n[:2]).max() < 0.05 * answer.force_world_n[2]


async def test_a_finger_in_the_air_sees_the_body_at_rest_and_its_stiffness(bench: Bench) -> None:
    answer = await bench.push(fingertip((0.01, 0.0, 0.03)))
    assert not answer.displacement_world_m.any()
    assert not answer.force_world_n.any()
    assert answer.in_range
    assert 20.0 < answer.stiffness_n_per_m < 80.0


async def test_a_lost_finger_is_held_and_then_the_body_springs_back(bench: Bench) -> None:
    lost = fingertip((0.0, 0.0, -0.004), valid=False)
    untouched = await bench.push(lost)
    assert not untouched.displacement_world_m.any()
    assert untouched.stiffness_n_per_m > 0.0
    good = await bench.push(fingertip((0.0, 0.0, -0.004)), 1_000_000_000)
    held = await bench.push(lost, 1_090_000_000)
    assert np.array_equal(held.displacement_world_m, good.displacement_world_m)
    dents = []
    for ms in range(100, 1500, 10):
        answer = await bench.push(lost, 1_000_000_000 + ms * 1_000_000)
        dents.append(-float(answer.displacement_world_m[:, 2].min()))
    steps = -np.diff(dents)
    assert (steps >= 0).all()
    assert steps.max() < 0.08 * dents[0]
    assert dents[-1] < 1e-3 * dents[0]
    again = await bench.push(fingertip((0.0, 0.0, -0.004)), 3_000_000_000)
    assert np.array_equal(again.displacement_world_m, good.displacement_world_m)


async def test_lead_moves_the_finger_along_its_velocity(cache: str, bench: Bench) -> None:
    ahead = Bench(cache_dir=cache, prediction_horizon_s=0.1)
    await ahead.node.setup()
    await ahead.node.step("scene", scene(), header())
    moving = await ahead.push(fingertip((0.0, 0.0, -0.002), velocity=(0.0, 0.0, -0.02)))
    there = await bench.push(fingertip((0.0, 0.0, -0.004)))
    assert moving.push_depth_m == pytest.approx(there.push_depth_m)


@pytest.mark.parametrize(
    "rpy", [(0.0, 0.0, 0.0), (0.0, 0.0, np.pi / 2), (2.0, 0.0, 0.0), (0.3, 0.0, 1.0)]
)
async def test_the_body_may_have_any_orientation(cache: str, rpy: tuple[float, ...]) -> None:
    bench = Bench(cache_dir=cache)
    await bench.node.setup()
    pose = {"position_m": [0.01, 0.02, -0.0353553], "rpy_rad": list(rpy)}
    await bench.node.step("scene", scene(world_from_object=pose), header())
    answer = await bench.push(fingertip((0.01, 0.02, -0.004)))
    assert answer.force_world_n[2] > 0.05
    skin = bench.skin().vertices_world_m
    deepest = int(answer.displacement_world_m[:, 2].argmin())
    assert skin[deepest] == pytest.approx([0.01, 0.02, 0.0], abs=0.008)


async def test_a_new_material_needs_no_new_precomputation(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = await bench.push(fingertip((0.0, 0.0, -0.004)))

    def refuse(*_: Any) -> None:
        raise AssertionError("nothing is to be computed")

    monkeypatch.setattr(precompute, "load_or_compute", refuse)
    twice = scene(material={"young_modulus_pa": 8000.0, "poisson_ratio": 0.45})
    await bench.node.step("scene", twice, header())
    after = await bench.push(fingertip((0.0, 0.0, -0.004)))
    assert after.force_world_n == pytest.approx(2 * before.force_world_n, rel=1e-5)
    assert after.mesh_id == before.mesh_id
    assert [name for name, _, _ in bench.sent].count("skin") == 2


async def test_another_object_replaces_the_first(bench: Bench) -> None:
    before = await bench.push(fingertip((0.0, 0.0, -0.004)))
    thin = {"shape": "cylinder", "radius_m": 0.03, "length_m": 0.1}
    await bench.node.step("scene", scene(geometry=thin), header())
    after = await bench.push(fingertip((0.0, 0.0, -0.01)))
    assert after.mesh_id == bench.skin().mesh_id != before.mesh_id
    assert len(after.displacement_world_m) == len(bench.skin().vertices_world_m)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"world_from_object": {"position_m": [0, 0, 0], "rpy_rad": [0, np.pi / 2, 0]}},
            "towards the user",
        ),
        ({"support": {"kind": "strip", "angle_rad": 6.5}}, "support.angle_rad"),
        ({"material": {"young_modulus_pa": 4000.0, "poisson_ratio": 0.49995}}, "poisson_ratio"),
        ({"geometry": {"shape": "cylinder", "radius_m": 0.01, "length_m": 0.1}}, "skin_spacing_m"),
    ],
)
async def test_an_impossible_object_is_an_error_with_its_reason(
    cache: str, change: dict[str, Any], words: str
) -> None:
    bench = Bench(cache_dir=cache)
    await bench.node.setup()
    await bench.node.step("scene", scene(**change), header())
    assert bench.node.errors == 1
    assert words in bench.node.last_error
    assert words in bench.node.note
    await bench.node.step("fingertip", fingertip((0, 0, 0)), header())
    assert bench.sent == []


async def test_closing_interrupts_the_precomputation(tmp_path: Path) -> None:
    bench = Bench(cache_dir=str(tmp_path))
    await bench.node.setup()
    building = asyncio.create_task(bench.node.step("scene", scene(), header()))
    while "precomputing" not in bench.node.note:
        assert not building.done()
        await asyncio.sleep(0)
    await bench.node.close()
    await building
    assert "interrupted" in bench.node.note
    assert bench.node.errors == 0
    assert bench.sent == []
    assert not any(path.suffix == ".npz" for path in tmp_path.iterdir())  # noqa: ASYNC240


async def test_a_newer_scene_interrupts_the_precomputation(
    cache: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Earlier, a cached scene waited for the computation of the scene that it replaced."""
    begun, meshed, ended = threading.Event(), threading.Event(), threading.Event()

    def endless(spec: Any, progress: Any, parts: Any = None) -> Any:
        begun.set()
        meshed.wait()
        try:
            while True:
                progress(0, 1, "")
                time.sleep(0.001)
        finally:
            ended.set()

    bench = Bench(cache_dir=cache)
    await bench.node.setup()
    await bench.node.step("scene", scene(), header(1))
    monkeypatch.setattr(precompute, "compute", endless)
    thin = {"shape": "cylinder", "radius_m": 0.031, "length_m": 0.1}
    thinner = thin | {"radius_m": 0.029}
    try:
        bench.node.deliver("scene", scene(geometry=thin), header(2))
        assert await asyncio.to_thread(begun.wait, DEADLINE_S)
        bench.node.deliver("scene", scene(geometry=thinner), header(3))
        bench.node.deliver("scene", scene(), header(4))
        async with asyncio.timeout(DEADLINE_S):
            await asyncio.gather(*bench.node.mailbox_tasks())
        meshed.set()
        assert await asyncio.to_thread(ended.wait, DEADLINE_S), "the abandoned work goes on"
    finally:
        meshed.set()
        await bench.node.close()
    assert [head.source_ns for name, _, head in bench.sent if name == "skin"] == [1, 4]
    assert bench.node.note.startswith("soft body by linear, force error up to ")
    assert bench.node.errors == 0, bench.node.last_error


async def test_the_same_messages_give_the_same_bytes(cache: str) -> None:
    def wiggle(i: int) -> NDArray[np.float64]:
        return np.array([1e-3 * i, 5e-4 * i, -0.006 * np.sin(0.3 * i)])

    runs = []
    for _ in range(2):
        bench = Bench(cache_dir=cache)
        await bench.node.setup()
        await bench.node.step("scene", scene(), header())
        answers = [await bench.push(fingertip(tuple(wiggle(i))), i) for i in range(20)]
        runs.append(b"".join(a.displacement_world_m.tobytes() for a in answers))
    assert runs[0] == runs[1]


@pytest.fixture
def few_pushes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(snapshots, "DEPTHS_M", (0.0015, 0.003, 0.006))
    monkeypatch.setattr(snapshots, "QUICK_DEPTHS_M", (0.003, 0.006))
    monkeypatch.setattr(snapshots, "FINE_DEPTHS_M", (0.003,))
    monkeypatch.setattr(snapshots, "FINE_RATIO", 1.0)
    monkeypatch.setattr(snapshots, "SPACING_RATIO", 1.0)
    monkeypatch.setattr(snapshots, "STATIONS", (0.0,))
    monkeypatch.setattr(snapshots, "ANGLE_STEP_RAD", 2.0)
    monkeypatch.setattr(cylinder, "FOCUS_GROWTH", 0.8)
    # Processes in the background take minutes to start beside other tests.
    monkeypatch.setattr(
        soft_body_factory, "local_processes", lambda count: nullcontext(InlineExecutor())
    )


async def test_the_table_is_made_while_the_linear_method_answers(
    few_pushes: None, tmp_path: Path
) -> None:
    small = scene(
        geometry={"shape": "cylinder", "radius_m": 0.028, "length_m": 0.06},
        world_from_object={"position_m": [0.0, 0.0, -0.028], "rpy_rad": [0.0, 0.0, 0.0]},
    )
    bench = Bench(cache_dir=tmp_path, method="nonlinear_table", workers=1)
    await bench.node.setup()
    await bench.node.step("scene", small, header())
    tip = fingertip((0.0, 0.0, -0.003))
    first = await bench.push(tip)
    assert first.method == "linear"
    methods, forces = ["linear"], [first.force_world_n[2]]
    while methods[-1] != "nonlinear_table":
        assert bench.node.errors == 0, bench.node.last_error
        await asyncio.sleep(0.05)
        now = await bench.push(tip)
        if now.method != methods[-1]:
            # the clock stands still, so that a new method begins with the force of the old one
            assert now.force_world_n[2] == pytest.approx(forces[-1], rel=1e-6)
            methods.append(now.method)
            assert now.method in bench.node.note
            assert "force error up to" in bench.node.note
            assert "ready" not in bench.node.note
    assert methods == ["linear", "quick_table", "nonlinear_table"]
    bench.node.clock.move_to(bench.node.clock.now_ns() + round(1e9 * BLEND_S))
    first = await bench.push(tip)
    assert first.in_range
    assert first.force_world_n[2] < 0.95 * forces[0]
    await bench.node.close()
    # from now on it is there from the start, and for who leaves the choice to the node
    again = Bench(cache_dir=tmp_path)
    await again.node.setup()
    await again.node.step("scene", small, header())
    answer = await again.push(tip)
    assert answer.method == "nonlinear_table"
    assert answer.displacement_world_m.tobytes() == first.displacement_world_m.tobytes()
    await again.node.close()
    assert (bench.node.errors, again.node.errors) == (0, 0)


class Scaled(Named):
    """A soft-body method under another name, with scaled forces and displacements."""

    def __init__(self, method: Any, name: str, ratio: float) -> None:
        super().__init__(method, name)
        self._ratio = ratio

    def respond(self, query: ContactQuery) -> Response:
        found = self._method.respond(query)
        return replace(
            found,
            force_n=self._ratio * found.force_n,
            displacement=np.float32(self._ratio) * found.displacement,
        )


async def test_better_methods_replace_others_without_a_step(
    cache: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = threading.Event()

    def build_table(
        factory: Any, scene: Scene, linear: SceneBody, progress: Any, on_quick: Any
    ) -> SceneBody:
        quick = Scaled(linear.method, "quick_table", 0.8)
        on_quick(replace(linear, method=quick))
        assert go_on.wait(DEADLINE_S)
        whole = Scaled(linear.method, "nonlinear_table", 0.6)
        return replace(linear, method=whole)

    monkeypatch.setattr(SoftBodyFactory, "build_table", build_table)
    bench = Bench(cache_dir=cache, compute_table=True)
    await bench.node.setup()
    await bench.node.step("scene", scene(), header())
    tip, clock = fingertip((0.0, 0.0, -0.003)), bench.node.clock

    async def wait_for(method: str) -> float:
        async with asyncio.timeout(DEADLINE_S):
            while (await bench.push(tip)).method != method:  # noqa: ASYNC110  # set by a thread
                await asyncio.sleep(0)
        assert f"{method}, force error up to 76 % at 1 mm and 26 % at 5 mm depth" in bench.node.note
        return float((await bench.push(tip)).force_world_n[2])

    async def force_after(seconds: float) -> float:
        clock.move_to(clock.now_ns() + round(1e9 * seconds))
        return float((await bench.push(tip)).force_world_n[2])

    assert bench.node.note.endswith("; the nonlinear table is being computed")
    first = float((await bench.push(tip)).force_world_n[2])
    assert await wait_for("quick_table") == pytest.approx(first)
    assert await force_after(0.5 * BLEND_S) == pytest.approx(0.9 * first)
    go_on.set()
    assert await wait_for("nonlinear_table") == pytest.approx(0.9 * first)  # amid the first blend
    # The stated error is that of the least precise method that still contributes.
    answers = [await bench.push(tip)]
    assert answers[0].force_error_ratio == pytest.approx(0.32, abs=1e-3)
    while answers[-1].in_transition:
        clock.move_to(clock.now_ns() + 16_666_667)
        answers.append(await bench.push(tip))
    assert (
        "nonlinear_table, force error up to 7 % at 1 mm and 3 % at 5 mm depth relative to"
        in bench.node.note
    )
    assert {round(one.force_error_ratio, 2) for one in answers} == {0.32, 0.1, 0.03}
    forces = np.array([one.force_world_n[2] for one in answers])
    dents = np.array([one.displacement_world_m for one in answers])
    assert forces[-1] == pytest.approx(0.6 * first)
    # At 60 Hz no answer differs from the last one by more than 0.3 % of the force or the shape.
    assert np.abs(np.diff(forces)).max() < MAX_STEP_RATIO * first
    assert np.abs(np.diff(dents, axis=0)).max() < MAX_STEP_RATIO * np.abs(dents[0]).max()
    await bench.node.close()
    assert bench.node.errors == 0, bench.node.last_error


async def test_a_transition_ends_while_the_finger_is_not_detected(bench: Bench) -> None:
    linear, tip = bench.node._bodies["linear"], fingertip((0.0, 0.0, -0.003))
    await bench.push(tip)
    better = replace(linear, method=Named(linear.method, "quick_table"))
    bench.node._set_bodies([better])
    lost = fingertip((0.0, 0.0, -0.003), valid=False)
    assert (await bench.push(lost)).in_transition
    clock = bench.node.clock
    clock.move_to(clock.now_ns() + round(1e9 * BLEND_S))
    assert not (await bench.push(lost)).in_transition


async def test_another_scene_ends_the_making_of_a_table(few_pushes: None, tmp_path: Path) -> None:
    bench = Bench(cache_dir=tmp_path, method="nonlinear_table", workers=1)
    await bench.node.setup()
    await bench.node.step("scene", scene(), header())
    while "snapshots for" not in bench.node.note:  # noqa: ASYNC110  # notes come without an event
        await asyncio.sleep(0.01)
    await bench.node.step("scene", scene(support={"kind": "strip", "angle_rad": 1.2}), header())
    await bench.node.close()
    assert bench.node.errors == 0, bench.node.last_error
    assert not any("table" in path.name and path.suffix == ".npz" for path in tmp_path.iterdir())  # noqa: ASYNC240


async def test_a_late_method_is_replaced_by_a_faster_one_and_reported(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow = {"linear": 0.0}
    clock = bench.node.clock
    assert isinstance(clock, VirtualClock)
    linear = bench.node._bodies["linear"]
    bench.node._set_bodies([linear, replace(linear, method=Named(linear.method, "quick_table"))])
    respond = SceneBody.respond

    def timed(body: SceneBody, *rest: Any) -> Any:
        clock.move_to(clock.now_ns() + int(1e9 * slow.get(body.method.name, 0.0)))
        return respond(body, *rest)

    monkeypatch.setattr(SceneBody, "respond", timed)
    tip = fingertip((0.0, 0.0, -0.003))
    assert (await bench.push(tip)).method == "linear"
    slow["linear"] = 0.02
    methods = [(await bench.push(tip)).method for _ in range(10)]
    assert methods == ["linear"] * 5 + ["quick_table"] * 5
    assert "linear was late" in bench.node.note


async def test_a_late_method_is_replaced_without_a_step(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    linear, clock = bench.node._bodies["linear"], bench.node.clock
    bench.node._set_bodies(
        [linear, replace(linear, method=Scaled(linear.method, "quick_table", 0.7))]
    )
    clock.move_to(clock.now_ns() + round(1e9 * BLEND_S))
    respond = SceneBody.respond

    def timed(body: SceneBody, *rest: Any) -> Any:
        clock.move_to(clock.now_ns() + (10_000_000 if body is linear else 0))
        return respond(body, *rest)

    monkeypatch.setattr(SceneBody, "respond", timed)
    tip = fingertip((0.0, 0.0, -0.003))
    answers = []
    for _ in range(320):
        clock.move_to(clock.now_ns() + 16_666_667)
        answers.append(await bench.push(tip))
    forces = np.array([one.force_world_n[2] for one in answers])
    assert {one.method for one in answers} == {"linear", "quick_table"}
    assert forces[-1] == pytest.approx(0.7 * forces[0])
    assert np.abs(np.diff(forces)).max() < MAX_STEP_RATIO * forces[0]


async def test_with_friction_the_finger_drags_the_skin_until_it_slips(cache: str) -> None:
    rough = Bench(cache_dir=cache, friction_ratio=0.5)
    await rough.node.setup()
    await rough.node.step("scene", scene(), header())
    await rough.push(fingertip((0.0, 0.0, -0.0001)))
    ratios = []
    for i in range(60):
        answer = await rough.push(fingertip((2e-4 * i, 0.0, -0.004)))
        ratios.append(-answer.force_world_n[0] / answer.force_world_n[2])
    assert answer.method == "linear"
    assert ratios[5] > ratios[1] > 0.02
    assert max(ratios) == pytest.approx(0.5, abs=0.05)
    assert min(ratios[-10:]) > 0.4
    await rough.node.close()
    assert rough.node.errors == 0, rough.node.last_error
