"""Test the soft-body node by the calls of the runner."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.messages.base import Header, Message
from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.notes import NoteCode
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Fingertip, Skin, SoftBody
from flexsheet.nodes.cache import save_cached
from flexsheet.nodes.fem_solver import precompute
from flexsheet.nodes.fem_solver.body import make_soft_body_spec, make_table_spec
from flexsheet.nodes.fem_solver.node import FemSolver
from flexsheet.nodes.fem_solver.parameters import FemSolverParameters
from flexsheet.nodes.fem_solver.precompute_table import make_table_cache
from tests.fingertips import fingertip as even_fingertip
from tests.node_harness import NodeHarness
from tests.note_text import note_text
from tests.scenes import load_values
from tests.soft_bodies import make_even_table

SPACING_M = 0.007


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


class Bench(NodeHarness[FemSolver, VirtualClock]):
    """A soft-body node that receives fingertips from the test."""

    def __init__(self, **parameters: Any) -> None:
        given = FemSolverParameters(
            **{"skin_spacing_m": SPACING_M, "method": "linear", **parameters}
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
    assert "scene" in note_text(bench.node)


async def test_the_skin_has_the_pose_of_the_scene(bench: Bench) -> None:
    skin = bench.skin()
    assert bench.sent[0][2].source_ns == 5
    low, high = skin.vertices_world_m.min(axis=0), skin.vertices_world_m.max(axis=0)
    assert low == pytest.approx([-0.06, -0.0353553, -0.0707106], abs=2e-3)
    assert high == pytest.approx([0.06, 0.0353553, 0.0], abs=2e-3)
    assert note_text(bench.node).startswith("soft body by linear, force error up to ")


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

    monkeypatch.setattr(precompute, "compute", refuse)
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
    assert words in note_text(bench.node)
    await bench.node.step("fingertip", fingertip((0, 0, 0)), header())
    assert bench.sent == []


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


@pytest.mark.parametrize("coarse", [True, False])
async def test_a_cached_table_is_used(
    cache: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, coarse: bool
) -> None:
    spec = make_soft_body_spec(scene(), SPACING_M)
    model = precompute.load_or_compute(spec, Path(cache), lambda *_: None)
    save_cached(precompute.response_cache(spec), tmp_path, model)
    table = make_even_table(model.response, 0.01)
    table_spec = make_table_spec(scene(), spec, coarse=coarse)
    save_cached(make_table_cache(table_spec), tmp_path, table)
    monkeypatch.setattr(precompute, "compute", pytest.fail)
    bench = Bench(cache_dir=tmp_path, method=None)
    await bench.node.setup()
    await bench.node.step("scene", scene(), header())
    answer = await bench.push(fingertip((0.0, 0.0, -0.003)))
    assert answer.method == ("coarse_table" if coarse else "nonlinear_table")
    assert answer.force_world_n[2] == pytest.approx(4000.0 * 0.01 * 0.003, rel=1e-3)
    assert note_text(bench.node).startswith(f"soft body by {answer.method}, force error up to ")
    assert "precompute" not in note_text(bench.node)
    assert bench.node.errors == 0, bench.node.last_error


async def test_a_missing_table_is_reported_and_not_computed(cache: str) -> None:
    bench = Bench(cache_dir=cache, method="nonlinear_table")
    await bench.node.setup()
    await bench.node.step("scene", scene(), header())
    assert (await bench.push(fingertip((0.0, 0.0, -0.003)))).method == "linear"
    assert [note.code for note in bench.node.notes] == [NoteCode.SOFT_BODY_TABLE_MISSING]
    assert note_text(bench.node).endswith("run flexsheet precompute SCENE")
    assert not any("table" in path.name for path in Path(cache).iterdir())  # noqa: ASYNC240
