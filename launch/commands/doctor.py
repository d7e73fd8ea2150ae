"""`flexsheet doctor`: check this computer, the hosts of a graph, and the range of the arms."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flexsheet.launch.commands.options import JsonOption, SceneArgument
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

if TYPE_CHECKING:
    pass

app = typer.Typer(
    add_completion=False,
    invoke_without_command=True,
    help="Check this computer, and all hosts of the running graph.",
    epilog=examples("flexsheet doctor", "flexsheet doctor --sweep", "flexsheet doctor --json"),
)


@app.callback()
def doctor(
    context: typer.Context,
    sweep: Annotated[
        bool,
        typer.Option(
            "--sweep", help="First end processes that crashed launchers have left running."
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Check that this computer can run flexsheet.

    If a graph of several computers is running, all of them are checked. The exit code is 1 if a
    check fails.
    """
    if context.invoked_subcommand is not None:
        return
    from flexsheet.launch.commands.doctor_hosts import check_running_graph, print_findings
    from flexsheet.launch.health.doctor import check_computer
    from flexsheet.launch.running.runs import sweep as sweep_leftovers

    if sweep:
        ended = sweep_leftovers()
        words.print(f"ended {len(ended)} processes that crashed launchers had left running")
    with words.status("checking"):
        findings = [*check_computer(), *check_running_graph()]
    if as_json:
        print_json([asdict(one) for one in findings])
    else:
        print_findings(findings)
    if any(one.state == "failed" for one in findings):
        raise typer.Exit(FAILED)


@app.command(
    "scene",
    epilog=examples("flexsheet doctor scene launch/scenes/cylinder.yaml"),
)
def check_scene(
    scene_file: SceneArgument,
    as_json: JsonOption = False,
) -> None:
    """Check that both arms reach the whole working range of a scene.

    The command checks samples of all tilts and push depths in the range, at the minimum and the
    maximum stretch of the sheet. It prints the maximum finger speed that the arms can follow. The
    exit code is 1 if the arms cannot reach a sample. A warning is printed if they reach all samples
    but cannot follow the maximum finger speed of the scene.

    The joint solutions of an RV-1A or RV-2FR have names. "Shoulder front" means that the wrist
    centre is in front of the plane through the axes of J1 and J2. "Elbow up" means that J3 is
    greater than the angle at which the arm is straight. "Wrist flipped" means that J5 is negative.
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
                f"doctor compliance {scene_file}"
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
