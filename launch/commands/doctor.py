"""`flexsheet doctor`: check this computer, the hosts of a graph, and the range of the arms."""

from __future__ import annotations

import asyncio
import math
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flexsheet.launch.commands import options
from flexsheet.launch.commands.graph import running_graph
from flexsheet.launch.commands.options import JsonOption
from flexsheet.launch.commands.output import (
    FAILED,
    CommandError,
    examples,
    print_columns,
    print_fields,
    print_json,
    print_result,
    print_table,
    progress_words,
    words,
)
from flexsheet.messages.units import format_percent

if TYPE_CHECKING:
    from flexsheet.launch.health.doctor import Finding
    from flexsheet.launch.plans.plan_model import ResolvedGraph
    from flexsheet.launch.running.runs import Run

app = options.make_app()

TIMEOUT_S = 4.0
"""The maximum time to wait for the answers of the hosts, in seconds."""


@app.command(
    epilog=examples(
        "flexsheet doctor",
        "flexsheet doctor --launch launch/lab.yaml --host left",
        "flexsheet doctor --scene cylinder",
        "flexsheet doctor --scene cylinder --compliance --delay-ms 80",
    ),
)
def doctor(
    *,
    sweep: Annotated[
        bool,
        typer.Option(
            "--sweep", help="First end processes that crashed launchers have left running."
        ),
    ] = False,
    launch_file: Annotated[
        Path | None,
        typer.Option(
            "--launch", help="Launch file whose hosts are checked, too.", **options.LAUNCH_FILE
        ),
    ] = None,
    host: Annotated[
        str | None,
        typer.Option(
            metavar="HOST",
            help="Name of this computer in the launch file; default: determined from its address.",
        ),
    ] = None,
    scene_file: Annotated[
        Path | None,
        typer.Option("--scene", help="Check only this scene, not the computer.", **options.SCENE),
    ] = None,
    compliance: Annotated[
        bool,
        typer.Option(
            "--compliance",
            help="With --scene: check that the sheet can feel as soft as the object.",
        ),
    ] = False,
    calibration: Annotated[
        Path | None,
        typer.Option(help="With --compliance: file from `flexsheet calibrate sheet`."),
    ] = None,
    delay_ms: Annotated[
        float,
        typer.Option(
            metavar="MS",
            min=0.0,
            max=500.0,
            help="With --compliance: delay from a measurement of the finger's depth to the sheet's "
            "motion, ms.",
        ),
    ] = 60.0,
    as_json: JsonOption = False,
) -> None:
    """Check that this computer can run flexsheet, or that the arms can present a scene.

    If a graph of several computers is running, all of them are checked. With --launch, the
    connections to all hosts of this launch file are checked. The exit code is 1 if a check fails.

    With --scene, the command checks samples of all tilts and push depths in the working range of
    the scene, at the minimum and the maximum stretch of the sheet. It prints the maximum finger
    speed that the arms can follow, and a warning if the scene's maximum is greater.

    The joint solutions of an RV-1A or RV-2FR have names. "Shoulder front" means that the wrist
    centre is in front of the plane through the axes of J1 and J2. "Elbow up" means that J3 is
    greater than the angle at which the arm is straight. "Wrist flipped" means that J5 is negative.

    With --compliance, the command compares the force of the object's model with the rendered force
    for pushes at the centre, and checks that hand and sheet cannot oscillate. The first call
    computes the object's model, which takes minutes.
    """
    if scene_file is not None and compliance:
        check_compliance(scene_file, calibration, delay_ms=delay_ms, as_json=as_json)
        return
    if scene_file is not None:
        check_scene(scene_file, as_json=as_json)
        return
    from flexsheet.launch.health.doctor import check_computer
    from flexsheet.launch.running.runs import sweep as sweep_leftovers

    if sweep:
        ended = sweep_leftovers()
        words.print(f"ended {len(ended)} processes that crashed launchers had left running")
    with words.status("checking"):
        findings = list(check_computer())
        if launch_file is None:
            findings += check_running_graph()
        else:
            findings += check_launch_file(launch_file, host)
    if as_json:
        print_json([asdict(one) for one in findings])
    else:
        print_table(
            ("host", "check", "state", "finding", "remedy"),
            [(one.host, one.check, one.state, one.what, one.remedy) for one in findings],
        )
    if any(one.state == "failed" for one in findings):
        raise typer.Exit(FAILED)


def check_scene(scene_file: Path, *, as_json: bool) -> None:
    """Check that both arms reach the working range of a scene, and print the result.

    Raises typer.Exit with the exit code 1 if the arms cannot reach a sample.
    """
    from flexsheet.launch.health.layout import check_layout, make_layout_result
    from flexsheet.launch.plans.plan import load_scene

    scene = load_scene(scene_file)
    with progress_words() as progress:
        layout = check_layout(scene, progress)
    result = make_layout_result(layout)
    if as_json:
        print_json(result)
    else:
        _print_layout(result, scene.working_range.speed_m_per_s)
        if scene.object.material is not None:
            words.print(
                "whether the sheet can be as stiff as the object is a separate check: flexsheet "
                f"doctor --scene {scene_file} --compliance"
            )
    if not layout.reachable:
        raise typer.Exit(FAILED)


def _describe_branch(branch: dict[str, Any]) -> str:
    """Describe a branch (joint solution) by names such as "elbow up", or by angles in degrees."""
    if "seed_rad" not in branch:
        return ", ".join(f"{part} {value}" for part, value in branch.items())
    degrees = (f"{math.degrees(angle):.0f}" for angle in branch["seed_rad"])
    return f"joints near ({', '.join(degrees)}) degrees"


def _print_layout(result: dict[str, Any], required_m_per_s: float) -> None:
    arms = result["arms"]
    print_fields(
        [
            ("scene", result["scene"]),
            ("reachable", "yes" if result["reachable"] else "NO"),
            (
                "reachable samples",
                f"{format_percent(result['fraction'])} of {result['samples']}, "
                + ", ".join(
                    f"{side} {format_percent(one['fraction'])}" for side, one in arms.items()
                ),
            ),
            *(
                (f"{side} arm's joint solution", _describe_branch(one["branch"]))
                for side, one in arms.items()
            ),
            (
                "speed",
                f"{1e3 * required_m_per_s:.0f} mm/s required; possible at all samples: "
                f"{1e3 * result['speed_everywhere_m_per_s']:.0f} mm/s, at half of the samples: "
                f"{1e3 * result['speed_at_half_m_per_s']:.0f} mm/s",
            ),
        ]
    )
    print()
    binding = [
        (
            side,
            one["limit"],
            format_percent(one["fraction"]),
            f"{math.degrees(one['first_tilt_rad']):.1f}°",
            f"{1e3 * one['first_depth_m']:.0f} mm",
        )
        for side, arm in arms.items()
        for one in arm["binding"]
    ]
    if binding:
        print_table(("arm", "active limit", "samples", "first at tilt", "depth"), binding)
        print()
    for path in result["blocked_paths"]:
        words.print(f"the arms cannot move along the path {path}")
    if result["fraction_at_working_speed"] < 1.0:
        print(
            f"warning: the arms follow {1e3 * required_m_per_s:.0f} mm/s at only "
            f"{format_percent(result['fraction_at_working_speed'])} of the samples"
        )


def check_compliance(
    scene_file: Path, calibration: Path | None, *, delay_ms: float, as_json: bool
) -> None:
    """Compare the force of the object's model with the rendered force, and print the result.

    The pushes are at the centre, up to the maximum depth of the scene. Also check that hand and
    sheet cannot oscillate.

    delay_ms: delay from a measurement of the finger's depth to the sheet's motion.

    Raises typer.Exit with the exit code 1 if a check fails.
    """
    from flexsheet.launch.health.compliance import compliance_result, compute_front_curve
    from flexsheet.launch.plans.plan import load_scene
    from flexsheet.messages.sheet_calibration import SheetCalibration
    from flexsheet.nodes.planner.compliance import ObjectCurve
    from flexsheet.nodes.planner.force_table import choose_force_model

    scene = load_scene(scene_file)
    law, _ = choose_force_model(
        scene, None if calibration is None else SheetCalibration.load(calibration)
    )
    with progress_words() as progress:
        curve = ObjectCurve.from_rows(compute_front_curve(scene, None, progress))
        progress("computing the rendered force")
        result = compliance_result(scene, law, curve, delay_s=1e-3 * delay_ms, progress=progress)
    if as_json:
        print_json(result)
    else:
        table = [
            {**row, "error": row["rendered_n"] / max(row["target_n"], 1e-9) - 1}
            for row in result["rows"]
        ]
        print_columns(
            table,
            {
                "depth, mm": ("depth_mm", ".0f"),
                "model, N": ("target_n", ".3f"),
                "rendered, N": ("rendered_n", ".3f"),
                "rendering error": ("error", "+.1%"),
                "normal offset, mm": ("normal_offset_mm", ".2f"),
            },
        )
        figures = {name: one for name, one in result.items() if name not in ("rows", "note")}
        print_result(figures, as_json=False)
        words.print(
            result["note"]
            or "the rendering error relative to the model of the object is within the tolerance"
        )
        words.print(
            "`flexsheet status` states the error of this model relative to the reference (node "
            "fem_solver)"
        )
    if result["note"]:
        raise typer.Exit(FAILED)


def check_launch_file(launch_file: Path, host: str | None) -> list[Finding]:
    """Check this computer and the connections to all hosts of a launch file.

    If the graph is running, all its hosts are asked.

    host: name of this computer in the launch file; None determines it from its address.
    """
    plan, run = _find_graph(launch_file)
    here = find_host(plan, run, host)
    if run is not None and run.host not in (None, here):
        run = None
    words.print(f"{plan.launch_file}, plan {plan.hash}, checked from {here}")
    return asyncio.run(check_hosts(plan, here, run, TIMEOUT_S))


def check_running_graph() -> list[Finding]:
    """Check the hosts of the running graph; return an empty list if no graph is running.

    If the graph runs on one host, only the results of the nodes' own calibration checks are
    returned.
    """
    from flexsheet.launch.health.doctor_hosts import SELF_CHECK
    from flexsheet.launch.running.runs import list_live_runs
    from flexsheet.launch.running.tools import tools_host

    if not any(run.plan_file.is_file() for run in list_live_runs()):
        return []
    plan, run = running_graph(None)
    findings = asyncio.run(check_hosts(plan, tools_host(run), run, TIMEOUT_S))
    if len(plan.hosts) == 1:
        return [one for one in findings if one.check == SELF_CHECK]
    return findings


def _find_graph(launch_file: Path) -> tuple[ResolvedGraph, Run | None]:
    """Return the resolved graph of a launch file, and its run on this computer.

    A run is one execution of a graph. The result contains None instead of a run if the graph is not
    running.
    """
    from flexsheet.launch.plans.plan import load_graph

    plan = load_graph(launch_file)
    try:
        running, run = running_graph(None)
    except CommandError:
        return plan, None
    same = Path(running.launch_file).resolve() == launch_file.resolve()
    return plan, run if same or running.hash == plan.hash else None


def find_host(plan: ResolvedGraph, run: Run | None, requested: str | None) -> str:
    """Return the name of this computer among the hosts of a graph.

    requested: name that the user has given. It is None if the user has given no name.

    Raises CommandError if the name is unknown, or if the addresses of this computer do not
    determine its name.
    """
    from flexsheet.launch.health.doctor_hosts import list_own_addresses
    from flexsheet.launch.plans.documents import did_you_mean
    from flexsheet.launch.plans.plan_model import MAIN
    from flexsheet.launch.running.tools import tools_host

    if requested is not None:
        if requested not in plan.hosts:
            raise CommandError(
                f"--host {requested}: unknown host; {did_you_mean(requested, list(plan.hosts))}"
            )
        return requested
    if run is not None:
        return tools_host(run)
    own = list_own_addresses()
    found = [name for name, address in plan.hosts.items() if address in own]
    if MAIN in found or len(found) == 1:
        return MAIN if MAIN in found else found[0]
    raise CommandError(
        f"no address of this computer matches exactly one host in {plan.launch_file} "
        f"({', '.join(plan.hosts.values())}); name the host with --host NAME"
    )


async def check_hosts(
    plan: ResolvedGraph, here: str, run: Run | None, timeout_s: float
) -> list[Finding]:
    """Check this computer, and test the connections to all hosts of a graph; return all findings.

    here: host name of this computer.
    """
    from flexsheet.launch.health.doctor_hosts import (
        check_before_start,
        evaluate_probes,
        find_key_problem,
    )
    from flexsheet.launch.health.probe import probe_all
    from flexsheet.launch.running.keys import secret_file
    from flexsheet.messages.security import KeyRing, write_ring

    key_problem = await asyncio.to_thread(find_key_problem, plan, here)
    with tempfile.TemporaryDirectory(prefix="flexsheet-") as folder:
        keys = None
        if plan.keys and key_problem is None:
            file = Path(folder) / "ring.json"
            write_ring(file, host=here, secret_file=secret_file(here), public=plan.keys)
            keys = KeyRing.load(file)
        probes = await probe_all(plan, here=here, keys=keys, run=run, timeout_s=timeout_s)
    findings = evaluate_probes(plan, here, probes)
    if probes[here].status is None:
        local = await asyncio.to_thread(lambda: list(check_before_start(plan, here, key_problem)))
        first = next((i for i, one in enumerate(findings) if one.host == here), 0)
        last = first + sum(one.host == here for one in findings)
        findings[last:last] = local
    return findings
