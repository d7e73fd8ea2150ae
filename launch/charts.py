"""Speed against accuracy: measures a method family on this machine and this scene, and draws it."""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Callable, Sequence
from dataclasses import asdict
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from typing import Any

from messages.scene import Scene
from nodes.methods import Family, Point, measure, pareto_front

FAMILIES: dict[str, str] = {
    "mark": "nodes.triangulator.families:MARK",
    "triangulation": "nodes.triangulator.families:TRIANGULATION",
    "tracking": "launch.families:TRACKING",
    "kinematics": "nodes.arm_bridge.kinematics:KINEMATICS",
    "soft-body": "nodes.fem_solver.families:SOFT_BODY",
    "correction": "launch.families:CORRECTION",
    "sheet-force": "launch.families:SHEET_FORCE",
    "sheet-shape": "launch.families:SHEET_SHAPE",
    "mesh-normal": "nodes.planner.families:MESH_NORMAL",
    "rolling": "nodes.planner.families:ROLLING",
}
"""Families by their name on the command line; each node's folder describes its own."""

REPEATS = 30


class UnknownFamilyError(KeyError):
    """A family name that is not in the table; the message suggests one that is."""

    def __str__(self) -> str:
        return str(self.args[0])


def family_named(name: str) -> Family:
    """The family of that name; raises UnknownFamilyError with the nearest name."""
    if name not in FAMILIES:
        near = get_close_matches(name, FAMILIES, n=1)
        hint = f'; did you mean "{near[0]}"?' if near else f"; there are: {', '.join(FAMILIES)}"
        raise UnknownFamilyError(f'unknown family "{name}"{hint}')
    module_name, _, attribute = FAMILIES[name].partition(":")
    family = getattr(import_module(module_name), attribute)
    assert isinstance(family, Family)
    return family


def measure_family(
    family: Family,
    scene: Scene,
    *,
    repeats: int = REPEATS,
    progress: Callable[[str], None] = lambda text: None,
) -> list[Point]:
    """Measure every trial of the family; `progress` is told of each."""
    points = []
    for trial in family.trials(scene):
        progress(f"{trial.method} {trial.case}")
        points.append(measure(trial, repeats=repeats))
    return points


def chart_result(family: Family, scene: Scene, points: Sequence[Point]) -> dict[str, Any]:
    """What `chart FAMILY --json` prints."""
    return {
        "family": family.name,
        "unit": family.unit,
        "reference": family.reference,
        "scene": scene.name,
        "tolerance": family.tolerance(scene),
        "machine": f"{platform.machine()}, Python {platform.python_version()}",
        "points": [asdict(point) for point in points],
        "front": pareto_front(points),
    }


def draw_chart(result: dict[str, Any], path: Path) -> None:
    """Draw the result: log time across, error up; a line is the front of one case.

    The scene's tolerance is dashed.  Errors below a ten-thousandth of it are drawn there: they are
    rounding, and would press all the rest into a corner.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 5.5), layout="constrained")
    axes = figure.subplots()
    methods = list(dict.fromkeys(point["method"] for point in result["points"]))
    least = 1e-4 * result["tolerance"]
    for index, method in enumerate(methods):
        color = f"C{index % 10}"
        mine = [point for point in result["points"] if point["method"] == method]
        for in_range, marker in ((True, "o"), (False, "x")):
            shown = [point for point in mine if point["in_range"] == in_range]
            if shown:
                front = "" if method not in result["front"] else ", on the front"
                axes.plot(
                    [point["median_s"] * 1e6 for point in shown],
                    [max(point["error"], least) for point in shown],
                    marker,
                    color=color,
                    alpha=0.7,
                    label=f"{method}{front if in_range else ' (out of its range)'}",
                )
    for case in unique_cases(result["points"]):
        usable = [
            point for point in result["points"] if point["in_range"] and point["case"] == case
        ]
        steps = sorted((point["median_s"] * 1e6, max(point["error"], least)) for point in usable)
        best = [
            step
            for i, step in enumerate(steps)
            if all(step[1] < earlier[1] for earlier in steps[:i])
        ]
        if len(best) > 1:
            axes.step(*zip(*best, strict=True), where="post", color="0.6", linewidth=0.8)
    axes.axhline(result["tolerance"], linestyle="--", color="0.2", label="the scene's tolerance")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("time per call, µs (median)")
    axes.set_ylabel(f"error, {result['unit']}")
    axes.set_title(f"{result['family']} — scene {result['scene']}, against {result['reference']}")
    axes.grid(visible=True, which="both", alpha=0.2)
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=110)


def unique_cases(points: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The cases of points, each once, in their order."""
    cases: list[dict[str, Any]] = []
    for point in points:
        if point["case"] not in cases:
            cases.append(point["case"])
    return cases


def write_chart(result: dict[str, Any], folder: Path) -> tuple[Path, Path]:
    """Write the picture and the numbers of a chart; returns both paths."""
    folder.mkdir(parents=True, exist_ok=True)
    picture, numbers = folder / f"{result['family']}.png", folder / f"{result['family']}.json"
    draw_chart(result, picture)
    numbers.write_text(json.dumps(finite(result), indent=1) + "\n")
    return picture, numbers


def finite(value: Any) -> Any:
    """The value with NaN and infinity as None: JSON has neither."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
