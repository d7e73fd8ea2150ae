"""Choose the fastest sufficient method of each method family for a scene, and check the system.

A method family contains interchangeable methods for one task. The methods are measured on this
computer over the scene's working range. A method is sufficient if it is valid over the whole
working range, and if its maximum error is at most the scene's tolerance minus a margin. If no
method is sufficient, the best insufficient method is chosen and reported.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, get_args

from flexsheet.launch.experiments import ExperimentError
from flexsheet.launch.methods.charts import (
    UnknownFamilyError,
    find_family,
    format_duration,
    measure_family,
)
from flexsheet.launch.methods.system_chart import Configuration, run_system_chart
from flexsheet.launch.plans.documents import did_you_mean
from flexsheet.messages.methods import Correction, SheetShapeMethod
from flexsheet.messages.scene import Scene
from flexsheet.nodes.methods import Point, Trial

REPEATS = 10
MARGIN = 0.2
"""The fraction of a tolerance that is reserved for errors in cases that were not measured."""

TIE_RATIO = 1.1
"""Two methods are considered equally fast if the ratio of their times is at most this value. The
most accurate of equally fast methods is chosen."""

STROKE_S = 10.0
Setting = str | dict[str, Any]


@dataclass(frozen=True, slots=True)
class Tunable:
    """A method family of which one method is chosen for a scene.

    settings: values that can be written into the scene, by the method's name in the chart.
    required_key: dotted key of the scene. If the scene does not have this key, no node uses the
        methods.
    """

    name: str
    settings: Mapping[str, Setting]
    required_key: str

    @property
    def key(self) -> str:
        """Return the key of the method family in the mapping `methods` of a scene."""
        return self.name.replace("-", "_")

    def is_used(self, scene: Scene) -> bool:
        """Return whether the nodes of this scene use the method family."""
        return attrgetter(self.required_key)(scene) is not None


TUNABLES = (
    Tunable("sheet-shape", {name: name for name in get_args(SheetShapeMethod)}, "projector"),
    Tunable("correction", {name: name for name in get_args(Correction)}, "projector"),
    Tunable(
        "soft-body",
        {
            "linear, coarse": {"method": "linear", "skin_spacing_m": 0.006},
            "linear, medium": {"method": "linear", "skin_spacing_m": 0.0045},
            "linear, fine": {"method": "linear", "skin_spacing_m": 0.003},
            "nonlinear table, medium": {"method": "nonlinear_table", "skin_spacing_m": 0.0045},
        },
        "object.material",
    ),
)
"""The tunable method families in the order of tuning. The sheet shape precedes the image
correction, because the error of the two-pass correction depends on the sheet shape."""

TWO_PASS_NAMES = {"four_triangles": "two_pass_triangles", "reduced_order": "two_pass"}
"""The name of the two-pass image correction in the chart, by the method of the sheet shape."""


def find_tunables(names: Sequence[str], scene: Scene) -> list[Tunable]:
    """Return the tunable method families that the scene uses, in the order of tuning.

    names: names of the method families. If empty, all families that the scene uses are returned.

    Raises UnknownFamilyError if a name is unknown, or if the scene does not use the family.
    """
    known = [one.name for one in TUNABLES]
    for name in names:
        if name not in known:
            raise UnknownFamilyError(f'unknown method family "{name}"; {did_you_mean(name, known)}')
    chosen = [one for one in TUNABLES if not names or one.name in names]
    for one in chosen:
        if names and not one.is_used(scene):
            raise UnknownFamilyError(
                f'scene "{scene.name}" does not use the method family "{one.name}": it has no '
                f"`{one.required_key}`; omit this family, or add that part to the scene"
            )
    return [one for one in chosen if one.is_used(scene)]


@dataclass(frozen=True, slots=True)
class MethodEvaluation:
    """The evaluation of one method over a scene's working range.

    median_s: median of the time per call over the cases.
    error: maximum error over the cases in which the method is valid; infinite if no reference is
        known.
    outside: number of cases outside the range in which the method is valid.
    wrong: number of other cases with an unknown error, or with an error above the tolerance minus
        the margin.
    """

    method: str
    setting: Setting
    median_s: float
    error: float
    cases: int
    outside: int
    wrong: int

    @property
    def is_sufficient(self) -> bool:
        return self.outside == self.wrong == 0


@dataclass(frozen=True, slots=True)
class Choice:
    """The chosen method of a method family, with the evaluations of all measured methods."""

    family: str
    key: str
    unit: str
    tolerance: float
    chosen: MethodEvaluation
    evaluations: tuple[MethodEvaluation, ...]

    def line(self) -> str:
        """Return the line of the scene's mapping `methods` that selects the method."""
        one, setting = self.chosen, self.chosen.setting
        if isinstance(setting, dict):
            inner = ", ".join(f"{name}: {value}" for name, value in setting.items())
            setting = f"{{{inner}}}"
        comment = f"{format_duration(one.median_s)}, error {one.error:.3g} of {self.tolerance:.3g}"
        if not one.is_sufficient:
            missed = one.outside + one.wrong
            comment = f"{comment} {self.unit}, not met in {missed} of {one.cases} cases"
            return f"  {self.key}: {setting}  # {comment}"
        return f"  {self.key}: {setting}  # {comment} {self.unit}"


def evaluate_methods(
    points: Sequence[Point], settings: Mapping[str, Setting], *, tolerance: float
) -> list[MethodEvaluation]:
    """Evaluate the methods in `settings` over all measured cases in the scene's working range.

    tolerance: maximum error, of which `MARGIN` must remain unused.
    """
    evaluations = []
    for method, setting in settings.items():
        own = [point for point in points if point.method == method and point.in_scene]
        if not own:
            continue
        inside = [point for point in own if point.in_range]
        times = sorted(point.median_s for point in own)
        evaluations.append(
            MethodEvaluation(
                method=method,
                setting=setting,
                median_s=times[len(times) // 2],
                error=max(
                    (point.error for point in inside if math.isfinite(point.error)),
                    default=math.inf,
                ),
                cases=len(own),
                outside=len(own) - len(inside),
                wrong=sum(not point.error <= (1.0 - MARGIN) * tolerance for point in inside),
            )
        )
    return evaluations


def choose(evaluations: Sequence[MethodEvaluation]) -> MethodEvaluation:
    """Return the fastest sufficient method.

    If several methods are equally fast, the most accurate method is returned. If no method is
    sufficient, the method that is valid in the most cases is returned.
    """
    sufficient = [one for one in evaluations if one.is_sufficient]
    if not sufficient:
        return min(evaluations, key=lambda one: (one.outside, one.wrong, one.error, one.median_s))
    fastest_s = min(one.median_s for one in sufficient)
    equal = [one for one in sufficient if one.median_s <= TIE_RATIO * fastest_s]
    return min(equal, key=lambda one: (one.error, one.median_s))


def tune(
    scene: Scene,
    tunables: Sequence[Tunable],
    progress: Callable[[str], None] = lambda text: None,
) -> list[Choice]:
    """Measure interchangeable methods, and choose one method of each method family in `tunables`.

    If a method family does not support the scene's shape, mesh or sheet, an exception of this
    family is raised.
    """
    choices: list[Choice] = []
    shape: str = scene.methods.sheet_shape
    for tunable in tunables:
        family, settings = find_family(tunable.name), dict(tunable.settings)
        if tunable.name == "correction":
            settings[TWO_PASS_NAMES[shape]] = settings.pop("two_pass")
        names = frozenset(settings)

        def is_needed(trial: Trial, names: frozenset[str] = names) -> bool:
            return trial.in_scene and trial.method in names

        points = measure_family(family, scene, repeats=REPEATS, progress=progress, select=is_needed)
        tolerance = family.tolerance(scene)
        evaluations = evaluate_methods(points, settings, tolerance=tolerance)
        chosen = choose(evaluations)
        if tunable.name == "sheet-shape":
            shape = chosen.method
        choices.append(
            Choice(tunable.name, tunable.key, family.unit, tolerance, chosen, tuple(evaluations))
        )
    return choices


def check_system(
    scene_file: Path,
    scene: Scene,
    choices: Sequence[Choice],
    folder: Path,
    progress: Callable[[str], None],
) -> dict[str, Any]:
    """Measure the errors and latencies of the whole system with the chosen methods in one run.

    Return the point of the configuration in the format of `flexsheet chart system --json`. Its keys
    `meets_tolerances` and `failing` contain the result of the check.

    Raises ExperimentError if a run fails.
    """
    chosen = {choice.key: choice.chosen.setting for choice in choices}
    methods = type(scene.methods).model_validate(scene.methods.model_dump() | chosen)
    result = run_system_chart(
        [scene_file],
        folder,
        progress,
        blocks=1,
        seconds=STROKE_S,
        apparatuses=0,
        list_configurations=lambda scene: [Configuration("chosen", methods)],
    )
    if result["failed"]:
        raise ExperimentError(f"a run failed: {result['failed'][0]['error']}; see {folder}")
    point: dict[str, Any] = result["points"][0]
    return point
