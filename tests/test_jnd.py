"""Test the stiffness experiment: the staircase, its file after interruptions, and the operator."""

from __future__ import annotations

import asyncio
import json
import math
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from typer.testing import CliRunner

from flexsheet.launch.cli import app
from flexsheet.launch.experiments import ExperimentError
from flexsheet.launch.experiments.driver import Driver
from flexsheet.launch.experiments.jnd import (
    COLUMNS,
    INCREMENTS,
    PairAnswer,
    PairTrial,
    SessionPlan,
    StaircaseEstimator,
    StaircaseSession,
    run_session,
)
from flexsheet.launch.experiments.jnd_operator import PairPresenter, replace_modulus
from flexsheet.launch.experiments.simulated_participant import Perception, SimulatedParticipant
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.running.runs import Run
from flexsheet.launch.running.supervisor import RunningGraph
from flexsheet.launch.running.tools import read_topic
from flexsheet.messages.base import Header, Message
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Force, Skin
from tests.arm_states import arm_state
from tests.test_compliance_controller import soft_body
from tests.test_planner import SCENE
from tests.waiting import DEADLINE_S

PLAN = SessionPlan("k7x2", seed=3, trials=30, reference_pa=2000.0, scene="abc")


def open_session(folder: Path, plan: SessionPlan = PLAN) -> StaircaseSession:
    return StaircaseSession(plan, folder / f"{plan.participant}.csv", now=lambda: "now")


def run(session: StaircaseSession, mind: SimulatedParticipant, *, until: int = 10_000) -> None:
    """Run the session with a participant; interrupt it before trial `until`."""

    async def present(trial: PairTrial) -> PairAnswer:
        if trial.number == until:
            raise KeyboardInterrupt
        return PairAnswer(mind.answer(trial.number, *trial.moduli_pa))

    if until <= session.plan.trials:
        with pytest.raises(KeyboardInterrupt):
            asyncio.run(run_session(session, present))
    else:
        asyncio.run(run_session(session, present))


def test_the_weber_fraction_of_20_participants_is_recovered(tmp_path: Path) -> None:
    outcome = CliRunner().invoke(
        app,
        [
            *("experiment", "jnd", "--simulated-participant", "--repeats", "20"),
            *("--seed", "100", "-o", str(tmp_path), "--json"),
        ],
    )
    assert outcome.exit_code == 0, outcome.output
    result = json.loads(outcome.stdout)
    summary = result["summary"]
    assert summary["median_error_percent"] < 10.0
    assert abs(summary["median_signed_error_percent"]) < 10.0
    assert summary["covered_percent"] >= 80.0
    assert len({row["csv"] for row in result["rows"]}) == 20
    for row in result["rows"]:
        assert json.loads((tmp_path / f"{row['participant']}.json").read_text()) == row


def test_the_true_weber_fraction_is_the_increment_of_75_percent_correct_answers() -> None:
    mind = SimulatedParticipant(5, Perception(noise=0.1, bias=0.0, lapse_rate=0.0))
    stiffer_pa = 1000.0 * (1.0 + mind.perception.weber_fraction)
    answers = [mind.answer(trial, 1000.0, stiffer_pa) for trial in range(4000)]
    assert np.mean(np.array(answers) == 2) == pytest.approx(0.75, abs=0.02)


def test_lapses_and_bias_do_not_count_as_a_worse_sense(tmp_path: Path) -> None:
    ratios = []
    for seed in range(10, 18):
        mind = SimulatedParticipant(seed, Perception(noise=0.15, bias=0.08, lapse_rate=0.06))
        session = open_session(tmp_path, SessionPlan(f"p{seed}", seed, 240, 2000.0))
        run(session, mind)
        ratios.append(session.estimator.weber_fraction / mind.perception.weber_fraction)
    assert np.exp(np.mean(np.log(ratios))) == pytest.approx(1.0, abs=0.15)


def test_the_staircase_goes_down_after_correct_answers_and_up_after_errors() -> None:
    estimator = StaircaseEstimator()
    first = estimator.choose(1)
    estimator.add(first, 1, True)
    estimator.add(first, 2, True)
    lower = estimator.choose(1)
    assert lower < first
    for _ in range(4):
        estimator.add(lower, 1, False)
    assert estimator.choose(1) > lower


@pytest.mark.parametrize("cut", [0, 1, 25])
def test_an_interrupted_session_continues_as_if_it_had_not_been(tmp_path: Path, cut: int) -> None:
    mind = SimulatedParticipant(8)
    (tmp_path / "whole").mkdir()
    whole, first = open_session(tmp_path / "whole"), open_session(tmp_path)
    run(whole, mind)
    run(first, mind, until=12)
    # A power failure while the last line is written leaves a part of it.
    data = first.file.read_bytes()
    first.file.write_bytes(data[: len(data) - cut])
    second = open_session(tmp_path)
    assert second.done == (11 if cut == 0 else 10)
    run(second, mind)
    assert second.file.read_bytes() == whole.file.read_bytes()
    assert {**second.result(), "csv": ""} == {**whole.result(), "csv": ""}
    assert open_session(tmp_path).next_trial() is None


def test_a_file_cut_within_the_header_starts_again(tmp_path: Path) -> None:
    (tmp_path / "k7x2.csv").write_text("participant,se")
    session = open_session(tmp_path)
    run(session, SimulatedParticipant(8), until=2)
    assert (tmp_path / "k7x2.csv").read_text().splitlines()[0] == ",".join(COLUMNS)


@pytest.mark.parametrize(
    ("changed", "text"),
    [
        (SessionPlan("k7x2", 4, 30, 2000.0, "abc"), 'seed is "3", but this session has "4"'),
        (SessionPlan("k7x2", 3, 30, 1000.0, "abc"), "reference_pa"),
        (SessionPlan("k7x2", 3, 30, 2000.0, "other"), "scene"),
        (SessionPlan("k7x2", 3, 5, 2000.0, "abc"), "the file has more than 5 trials"),
    ],
)
def test_a_file_of_another_session_is_refused(
    tmp_path: Path, changed: SessionPlan, text: str
) -> None:
    run(open_session(tmp_path), SimulatedParticipant(8), until=8)
    with pytest.raises(ExperimentError, match=text):
        open_session(tmp_path, changed)


@pytest.mark.parametrize("content", [b"a,b\n1,2\n", b"\xff\xfe\n"])
def test_another_file_is_not_overwritten(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "k7x2.csv").write_bytes(content)
    with pytest.raises(ExperimentError, match=r"k7x2\.csv"):
        open_session(tmp_path)
    assert (tmp_path / "k7x2.csv").read_bytes() == content


def test_a_changed_answer_is_reported_with_its_line(tmp_path: Path) -> None:
    run(open_session(tmp_path), SimulatedParticipant(8), until=3)
    file = tmp_path / "k7x2.csv"
    lines = file.read_text().splitlines()
    cells = lines[1].split(",")
    cells[COLUMNS.index("answer")] = "3"
    file.write_text("\n".join([lines[0], ",".join(cells), *lines[2:], ""]))
    with pytest.raises(ExperimentError, match=r'k7x2\.csv:2: answer is "3", expected 1 or 2'):
        open_session(tmp_path)


class FakeDriver:
    """Driver whose sheet reports a force that grows with the object's modulus."""

    def __init__(self) -> None:
        self.moduli_pa: list[float] = []

    def on_message(self, message: Message) -> None:
        raise AssertionError("the presenter does not listen")

    async def change_scene(self, scene: Scene) -> None:
        assert scene.object.material is not None
        self.moduli_pa.append(scene.object.material.young_modulus_pa)

    def push(self) -> None:
        for ratio in (0.5, 1.0, 0.1):
            force_n = 1e-3 * ratio * self.moduli_pa[-1]
            for valid in (True, False):
                self.on_message(
                    Force(
                        source="gauge",
                        axis="sheet_normal",
                        valid=valid,
                        reason="ok" if valid else "overload",
                        force_n=force_n if valid else 99.0,
                        standard_deviation_n=0.01,
                    )
                )


def make_presenter(lines: Iterator[str]) -> tuple[PairPresenter, FakeDriver]:
    driver = FakeDriver()

    async def ask(question: str) -> str:
        if "push" in question:
            driver.push()
        return next(lines)

    return PairPresenter(cast(Driver, driver), SCENE, ask), driver


def test_a_pair_is_presented_by_the_modulus_of_the_object() -> None:
    trial = PairTrial(1, 4, stiffer=2, moduli_pa=(2000.0, 2500.0), catch=False)
    presenter, driver = make_presenter(iter(["\n", "no\n", "\n", "maybe\n", "2\n"]))
    answer = asyncio.run(presenter.present(trial))
    assert driver.moduli_pa == [2000.0, 2500.0]
    assert (answer.stiffer, answer.forces_n) == (2, (2.0, 2.5))
    assert answer.depths_m == (None, None)
    assert answer.response_s is not None


def test_the_operator_can_interrupt(tmp_path: Path) -> None:
    presenter, _ = make_presenter(iter(["\n", "\n", "1\n", "\n", "Q\n"]))
    session = open_session(tmp_path)
    with pytest.raises(ExperimentError, match="run the same command again"):
        asyncio.run(run_session(session, presenter.present))
    assert session.done == open_session(tmp_path).done == 1


def test_a_rigid_object_is_refused() -> None:
    rigid = SCENE.model_copy(update={"object": SCENE.object.model_copy(update={"material": None})})
    with pytest.raises(ExperimentError, match=r"object\.material is missing"):
        replace_modulus(rigid, 1000.0)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--participant", "Jane Doe"], "letters, digits"),
        (["--repeats", "2"], "requires --simulated-participant"),
    ],
)
def test_wrong_options_are_refused(tmp_path: Path, options: list[str], text: str) -> None:
    command = ["experiment", "jnd", *options, "-o", str(tmp_path / "new")]
    outcome = CliRunner().invoke(app, command)
    assert outcome.exit_code != 0
    assert text in str(outcome.exception)
    assert not (tmp_path / "new").exists()


def test_the_increments_stay_within_twice_the_reference() -> None:
    assert math.isclose(float(INCREMENTS[-1]), 1.0)


async def test_the_scene_of_a_running_graph_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The paths of sockets must be short.
    folder = tempfile.mkdtemp(prefix="fs-", dir="/tmp")
    monkeypatch.setenv("FLEXSHEET_RUNS", folder)
    file = tmp_path / "graph.yaml"
    file.write_text("scene: cylinder\nnodes:\n  beacon: {type: 'tests.launch_nodes:Beacon'}\n")
    async with RunningGraph(load_graph(file)) as graph:
        await graph.wait_ready(DEADLINE_S)
        scenes = read_topic(graph, "scene")
        first, first_header = await anext(scenes)
        changed = replace_modulus(SCENE, 1234.0)
        source_ns = graph.publish_scene(changed)
        second, header = await anext(scenes)
        await scenes.aclose()
        late, _ = await anext(read_topic(graph, "scene", 1))
    assert isinstance(first, Scene)
    assert first.object.material == SCENE.object.material
    assert (header.sequence, header.source_ns) == (first_header.sequence + 1, source_ns)
    for scene in (second, late):
        assert isinstance(scene, Scene)
        assert scene.object.material == changed.object.material
    shutil.rmtree(folder)


async def test_a_changed_scene_counts_when_its_soft_body_answers() -> None:
    published: list[Scene] = []

    def publish(scene: Scene) -> int:
        published.append(scene)
        return 5_000

    plan = load_graph(Path(__file__).parent.parent / "launch" / "demo.yaml")
    driver = Driver(plan, Run("unused", Path("unused")), publish_scene=publish)

    def receive(topic: str, message: Message, source_ns: int) -> None:
        driver._make_handler(topic)(message, Header(1, source_ns, source_ns, "clock", "n", 1))

    for side in ("left", "right"):
        receive(f"arm_{side}", arm_state(side), 1)
    body = soft_body()
    receive("soft_body", body, 2)
    change = asyncio.create_task(driver.change_scene(SCENE))
    await asyncio.sleep(0)
    skin = Skin(
        mesh_id="m",
        vertices_world_m=np.zeros((0, 3), np.float32),
        triangles=np.zeros((0, 3), np.int32),
    )
    receive("skin", skin, 4_999)
    receive("soft_body", body, 4_999)
    await asyncio.sleep(0)
    assert not change.done()
    receive("skin", skin, 5_000)
    for _ in range(3):
        await asyncio.sleep(0)
    assert not change.done()
    receive("soft_body", body, 5_001)
    async with asyncio.timeout(DEADLINE_S):
        await change
    assert published == [SCENE]
