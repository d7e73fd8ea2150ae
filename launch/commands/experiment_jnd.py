"""`flexsheet experiment jnd`: measure the smallest stiffness difference that a person feels."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flexsheet.launch.commands import options
from flexsheet.launch.commands.experiment import app, make_result_folder
from flexsheet.launch.commands.output import (
    CommandError,
    examples,
    print_json,
    print_table,
    progress_bar,
    words,
)

if TYPE_CHECKING:
    from flexsheet.launch.experiments.jnd import SessionPlan, StaircaseSession
    from flexsheet.messages.scene import Scene


@app.command(
    epilog=examples(
        "flexsheet experiment jnd --participant k7x2 --output runs/jnd",
        "flexsheet experiment jnd --simulated-participant --repeats 20 --seed 100",
    )
)
def jnd(
    *,
    participant: Annotated[
        str,
        typer.Option(
            metavar="CODE", help="Random code that identifies the participant; do not use a name."
        ),
    ] = "p1",
    seed: Annotated[int, typer.Option(min=0, help="Random seed of the order of objects.")] = 1,
    trials: Annotated[
        int,
        typer.Option(
            min=20,
            max=2000,
            help="Number of trials; in each trial, the participant compares two objects.",
        ),
    ] = 240,
    reference_pa: Annotated[
        float | None,
        typer.Option(
            metavar="PA",
            min=1.0,
            help="Young's modulus of the reference object, Pa; default: half of the value in "
            "the scene. The other objects have up to twice this modulus.",
        ),
    ] = None,
    simulated: Annotated[
        bool,
        typer.Option(
            "--simulated-participant", help="Simulate the participant instead of starting a graph."
        ),
    ] = False,
    repeats: Annotated[
        int,
        typer.Option(
            min=1,
            max=1000,
            help="With --simulated-participant: number of participants. The first has the seed of "
            "--seed, and the others have the following seeds. Seeds 0-99 are for development.",
        ),
    ] = 1,
    launch_file: options.LaunchOption = options.DEMO,
    scene: options.OtherSceneOption = None,
    settings: options.SettingsOption = None,
    output: options.ResultFolderOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Measure a participant's Weber fraction of stiffness with pairs of soft objects.

    The participant says which object of each pair is stiffer, and an adaptive staircase chooses the
    next pair. The command writes every answer to CODE.csv immediately. To continue an interrupted
    session, run the command again with the same --output.
    """
    from flexsheet.launch.experiments.jnd import SessionPlan
    from flexsheet.launch.experiments.run import require_scene
    from flexsheet.launch.plans.plan import load_graph
    from flexsheet.messages.apparatus import identify_scene

    if not re.fullmatch(r"[A-Za-z0-9_-]{1,32}", participant):
        raise CommandError(f'--participant "{participant}": use 1 to 32 letters, digits, - and _')
    if repeats > 1 and not simulated:
        raise CommandError(
            "--repeats requires --simulated-participant; add it, or remove --repeats"
        )
    given = options.with_scene(settings, scene)
    loaded = require_scene(load_graph(launch_file, settings=given))
    folder = make_result_folder(output, "jnd")
    reference = _choose_reference_pa(loaded, reference_pa)
    plan = SessionPlan(
        participant, seed, trials, reference, f"{loaded.name}-{identify_scene(loaded)}"
    )
    if simulated:
        rows = _simulate(plan, folder, repeats)
    else:
        rows = [_measure(plan, folder, launch_file, given)]
    result = _summarize(rows, reference)
    if as_json:
        print_json(result)
        return
    cells = [
        [
            row["participant"],
            row["trials"],
            f"{row['weber_fraction']:.3f}",
            "{:.3f} to {:.3f}".format(*row["interval_95"]),
            f"{row['true_weber_fraction']:.3f}" if simulated else "-",
        ]
        for row in rows
    ]
    print_table(["participant", "trials", "Weber fraction", "95 % interval", "true"], cells)
    if simulated:
        words.print(f"median error: {result['summary']['median_error_percent']:.1f} %")
    words.print(f"trials: {folder}")


def _choose_reference_pa(scene: Scene, given: float | None) -> float:
    from flexsheet.launch.experiments.jnd_operator import replace_modulus

    material = replace_modulus(scene, given or 1.0).object.material
    assert material is not None
    assert scene.object.material is not None
    return given or 0.5 * scene.object.material.young_modulus_pa


def _simulate(plan: SessionPlan, folder: Path, repeats: int) -> list[dict[str, Any]]:
    import asyncio
    from dataclasses import replace

    from flexsheet.launch.experiments.jnd import PairAnswer, PairTrial, run_session
    from flexsheet.launch.experiments.simulated_participant import SimulatedParticipant

    rows: list[dict[str, Any]] = []
    with progress_bar("participants") as progress:
        for number in range(repeats):
            seed = plan.seed + number
            mind = SimulatedParticipant(seed)

            async def present(trial: PairTrial, mind: SimulatedParticipant = mind) -> PairAnswer:
                return PairAnswer(mind.answer(trial.number, *trial.moduli_pa))

            name = plan.participant if repeats == 1 else f"{plan.participant}-{seed}"
            session = _open(replace(plan, participant=name, seed=seed), folder)
            asyncio.run(run_session(session, present))
            true = mind.perception.weber_fraction
            row = session.result()
            error = 100.0 * (row["weber_fraction"] / true - 1.0)
            rows.append({**row, "true_weber_fraction": true, "error_percent": error})
            _write_result(rows[-1], folder)
            progress(number + 1, repeats)
    return rows


def _measure(
    plan: SessionPlan, folder: Path, launch_file: Path, settings: list[str]
) -> dict[str, Any]:
    from flexsheet.launch.experiments.jnd import run_session
    from flexsheet.launch.experiments.jnd_operator import (
        INSTRUCTIONS,
        PairPresenter,
        make_jnd_procedure,
    )
    from flexsheet.launch.experiments.run import run_experiment

    session = _open(plan, folder)
    words.print(INSTRUCTIONS)

    async def run(presenter: PairPresenter) -> None:
        await run_session(session, presenter.present)

    # A spinner would overwrite the operator's input. A bag is not recorded, because recorded motion
    # can identify a person.
    if session.done < plan.trials:
        run_experiment(launch_file, settings, None, make_jnd_procedure(run), words.print)
    row = session.result()
    _write_result(row, folder)
    return row


def _open(plan: SessionPlan, folder: Path) -> StaircaseSession:
    from datetime import UTC, datetime

    from flexsheet.launch.experiments.jnd import StaircaseSession

    return StaircaseSession(
        plan,
        folder / f"{plan.participant}.csv",
        now=lambda: datetime.now(UTC).isoformat(timespec="seconds"),
    )


def _write_result(row: dict[str, Any], folder: Path) -> None:
    import json

    from flexsheet.messages.files import write_file

    write_file(folder / f"{row['participant']}.json", json.dumps(row, indent=1) + "\n")


def _summarize(rows: list[dict[str, Any]], reference_pa: float) -> dict[str, Any]:
    """Return the JSON output of `flexsheet experiment jnd`.

    rows: one row per participant.
    reference_pa: Young's modulus of the reference object.
    """
    import numpy as np

    from flexsheet.launch.experiments.jnd import CRITERION

    result: dict[str, Any] = {
        "rows": rows,
        "method": "psi-marginal",
        "criterion": CRITERION,
        "reference_pa": reference_pa,
    }
    if "error_percent" in rows[0]:
        errors = np.array([row["error_percent"] for row in rows])
        covered = [
            row["interval_95"][0] <= row["true_weber_fraction"] <= row["interval_95"][1]
            for row in rows
        ]
        result["summary"] = {
            "median_error_percent": float(np.median(np.abs(errors))),
            "median_signed_error_percent": float(np.median(errors)),
            "covered_percent": 100.0 * float(np.mean(covered)),
        }
    return result
