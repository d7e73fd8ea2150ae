"""`flexsheet doctor`: check this computer, the hosts of a graph, and the range of the arms."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from flexsheet.launch.commands import options
from flexsheet.launch.commands.doctor_compliance import check_compliance
from flexsheet.launch.commands.doctor_hosts import (
    check_launch_file,
    check_running_graph,
    print_findings,
)
from flexsheet.launch.commands.options import JsonOption
from flexsheet.launch.commands.output import (
    FAILED,
    examples,
    print_fields,
    print_json,
    print_table,
    progress_words,
    words,
)
from flexsheet.messages.units import format_percent

app = options.make_app()


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
        print_findings(findings)
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
