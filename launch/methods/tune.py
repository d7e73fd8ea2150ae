"""Choose the fastest sufficient method of each method family, and write the choices to the scene.

A method family contains interchangeable methods for one task. The methods are measured on this
computer over the scene's working range. A method is sufficient if it is valid over the whole
working range. Its maximum error must also be at most the scene's tolerance minus a margin. If no
method is sufficient, the best insufficient method is chosen and reported.
"""

from __future__ import annotations

import errno
import json
import math
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any, get_args

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap

from flexsheet.launch.methods.charts import format_duration, git_commit, load_family, measure_family
from flexsheet.launch.methods.results import machine_name
from flexsheet.launch.plans.documents import BadInputError, Problem, did_you_mean
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.files import DISK_ERRORS, make_write_error
from flexsheet.messages.methods import (
    Correction,
    MarkerMethod,
    SheetForceMethod,
    SheetShapeMethod,
    TrackingMethod,
)
from flexsheet.messages.scene import Scene
from flexsheet.nodes.methods import Family, Point, Trial

REPEATS = 10
MARGIN = 0.2
"""The fraction of a tolerance that is reserved for errors in cases that were not measured."""
TIE_RATIO = 1.1
"""Two methods are considered equally fast if the ratio of their times is at most this value. The
most accurate of equally fast methods is chosen."""

Setting = str | dict[str, Any]


class UnknownTunableError(FlexsheetError, KeyError):
    """Raised if a method family does not exist, or cannot be tuned in the scene."""


@dataclass(frozen=True, slots=True)
class Tunable:
    """A set of interchangeable methods for one task, of which one is chosen for a scene.

    families: import locations `module:NAME` of the `Family` objects with the methods, in the order
        of measurement. The methods of later objects take minutes to prepare, so they are measured
        only if no earlier method is sufficient.
    settings: values that can be written into the scene, by the method's name in the chart.
    required_key: dotted key of the scene. If the scene does not have this key, no node uses the
        methods. None if no key is required.
    """

    name: str
    families: tuple[str, ...]
    settings: Mapping[str, Setting]
    required_key: str | None = None

    @property
    def key(self) -> str:
        """Return the key of the method family in the mapping `methods` of a scene."""
        return self.name.replace("-", "_")

    def is_used(self, scene: Scene) -> bool:
        """Return whether the nodes of this scene use the method family."""
        return self.required_key is None or attrgetter(self.required_key)(scene) is not None


def _make_settings(methods: object) -> dict[str, Setting]:
    """Return the scene setting of each method, by method name. The setting is the method's name.

    methods: `Literal` type that contains the method names.
    """
    return {name: name for name in get_args(methods)}


def _make_soft_body(method: str, skin_spacing_m: float) -> Setting:
    return {"method": method, "skin_spacing_m": skin_spacing_m}


_BENCHMARKS = "flexsheet.launch.methods.benchmarks"
_FEM_SOLVER = "flexsheet.nodes.fem_solver.benchmarks"
MATERIAL, PROJECTOR = "object.material", "projector"
TUNABLES = (
    Tunable(
        "marker", ("flexsheet.nodes.triangulator.benchmarks:MARKER",), _make_settings(MarkerMethod)
    ),
    Tunable("tracking", (f"{_BENCHMARKS}:TRACKING",), _make_settings(TrackingMethod)),
    Tunable(
        "sheet-force",
        (f"{_BENCHMARKS}:SHEET_LAWS", f"{_BENCHMARKS}:SHEET_FORCE"),
        _make_settings(SheetForceMethod),
        required_key=MATERIAL,
    ),
    Tunable(
        "sheet-shape",
        (f"{_BENCHMARKS}:QUICK_SHAPE", f"{_BENCHMARKS}:SHEET_SHAPE"),
        _make_settings(SheetShapeMethod),
        required_key=PROJECTOR,
    ),
    Tunable(
        "correction",
        (f"{_BENCHMARKS}:QUICK_CORRECTION", f"{_BENCHMARKS}:CORRECTION"),
        _make_settings(Correction),
        required_key=PROJECTOR,
    ),
    Tunable(
        "soft-body",
        (f"{_FEM_SOLVER}:SOFT_BODY_LINEAR", f"{_FEM_SOLVER}:SOFT_BODY_TABLES"),
        {
            "linear, coarse": _make_soft_body("linear", 0.006),
            "linear, medium": _make_soft_body("linear", 0.0045),
            "linear, fine": _make_soft_body("linear", 0.003),
            "nonlinear table, medium": _make_soft_body("nonlinear_table", 0.0045),
        },
        required_key=MATERIAL,
    ),
)
"""The tunable method families in the order of tuning. The sheet shape precedes the image
correction, because the settings of the correction depend on the sheet shape."""

TWO_PASS_NAMES = {
    "four_triangles": "two_pass_triangles",
    "reduced_order": "two_pass",
}
"""The name of the two-pass image correction in the chart, by the method of the sheet shape."""


def find_tunables(names: Sequence[str], scene: Scene) -> list[Tunable]:
    """Return the tunable method families that the scene uses, in the order of tuning.

    names: names of the method families. If empty, all families that the scene uses are returned.

    Raises UnknownTunableError if a name is unknown, or if the scene does not use the family.
    """
    known = [one.name for one in TUNABLES]
    for name in names:
        if name not in known:
            raise UnknownTunableError(
                f'unknown method family "{name}"; {did_you_mean(name, known)}'
            )
    chosen = [one for one in TUNABLES if not names or one.name in names]
    for one in chosen:
        if names and not one.is_used(scene):
            raise UnknownTunableError(
                f'scene "{scene.name}" does not use the method family "{one.name}": it has no '
                f"`{one.required_key}`; omit this family, or add that part to the scene"
            )
    return [one for one in chosen if one.is_used(scene)]


@dataclass(frozen=True, slots=True)
class MethodEvaluation:
    """The evaluation of one method over a scene's working range.

    median_s, slowest_s: median and maximum of the time per call over the cases.
    error: maximum error over the cases in which the method is valid; infinite if no reference is
        known.
    worst_case: case in which this error occurs.
    outside: cases outside the range in which the method is valid.
    wrong: other cases with an unknown error, or with an error above the tolerance minus a safety
        margin.
    points: measurements of all cases.
    """

    method: str
    setting: Setting
    median_s: float
    slowest_s: float
    error: float
    worst_case: Mapping[str, Any]
    cases: int
    outside: tuple[Mapping[str, Any], ...]
    wrong: tuple[Mapping[str, Any], ...]
    points: tuple[Point, ...] = ()

    @property
    def meets(self) -> bool:
        return not self.outside and not self.wrong

    @property
    def missed(self) -> int:
        return len(self.outside) + len(self.wrong)


@dataclass(frozen=True, slots=True)
class Choice:
    """The chosen method of a method family, with the evaluations of all measured methods.

    composed: whether the choice depends on the errors of the whole system. Otherwise, the choice
        depends only on the tolerance of this method family.
    """

    family: str
    key: str
    unit: str
    tolerance: float
    chosen: MethodEvaluation
    evaluations: tuple[MethodEvaluation, ...]
    composed: bool = False

    @property
    def met(self) -> bool:
        return self.composed or self.chosen.meets

    @property
    def spare_ratio(self) -> float:
        """Return the unused fraction of the tolerance, negative if the error exceeds it."""
        return 1.0 - self.chosen.error / self.tolerance

    def explain(self) -> str:
        """Return a sentence that states the chosen method and the reason for the choice."""
        if self.composed:
            return self._explain_composed()
        one, unit = self.chosen, self.unit
        allowed = f"{_format(self.tolerance)} {unit}"
        took = format_duration(one.median_s)
        if not self.met:
            near = f"best is {one.method} ({took}), outside in {one.missed} of {one.cases} cases"
            fault = self._describe_fault(one)
            return f"{self.family}: no method meets the tolerance {allowed}; {near}: {fault}"
        cheaper = [other for other in self.evaluations if other.median_s * TIE_RATIO < one.median_s]
        rest = "no method is faster"
        if cheaper:
            nearest = min(cheaper, key=_miss_key)
            rest = f"{nearest.method} is faster ({format_duration(nearest.median_s)}), but "
            rest += self._describe_fault(nearest)
        left = f"{one.method} ({took}), error {_format(one.error)}, tolerance {allowed}"
        return f"{self.family}: {left}; {rest}"

    def _explain_composed(self) -> str:
        one = self.chosen
        text = f"{self.family}: {one.method} ({format_duration(one.median_s)}), error "
        text += f"{_format(one.error)} {self.unit}"
        others = [
            f"{other.method} ({format_duration(other.median_s)}, {_format(other.error)} "
            f"{self.unit})"
            for other in self.evaluations
            if other is not one
        ]
        return f"{text}; alternatives: {', '.join(others)}" if others else text

    def _describe_fault(self, one: MethodEvaluation) -> str:
        parts = []
        if one.wrong:
            error = f"{_format(one.error)} {self.unit} at {_format_case(one.worst_case)}"
            parts.append(
                f"its error is {error}" if math.isfinite(one.error) else "it has no reference"
            )
        if one.outside:
            parts.append(f"it is out of range at {_format_case(one.outside[0])}")
        return " and ".join(parts)

    def report(self) -> dict[str, Any]:
        """Return the choice in the format of `flexsheet tune --json`."""
        return {
            "family": self.family,
            "key": self.key,
            "unit": self.unit,
            "tolerance": self.tolerance,
            "chosen": self.chosen.method,
            "setting": self.chosen.setting,
            "met": self.met,
            "error": self.chosen.error,
            "spare_ratio": self.spare_ratio,
            "sentence": self.explain(),
            "evaluations": [asdict(replace(one, points=())) for one in self.evaluations],
        }


def _format(value: float) -> str:
    return f"{value:.3g}"


def _format_case(case: Mapping[str, Any]) -> str:
    parts = (
        f"{name} {_format(value) if isinstance(value, float) else value}"
        for name, value in case.items()
        if name not in ("width_px", "height_px")
    )
    return ", ".join(parts)


def evaluate_methods(
    points: Sequence[Point],
    settings: Mapping[str, Setting],
    *,
    tolerance: float,
    margin: float = MARGIN,
) -> list[MethodEvaluation]:
    """Evaluate the methods in `settings` over all measured cases in the scene's working range.

    tolerance: maximum error.
    margin: fraction of the tolerance that the error must leave unused.
    """
    allowed, evaluations = (1.0 - margin) * tolerance, []
    for method, setting in settings.items():
        own = [point for point in points if point.method == method and point.in_scene]
        if not own:
            continue
        inside = [point for point in own if point.in_range]
        valid = [point for point in inside if math.isfinite(point.error)]
        worst = max(valid, key=lambda point: point.error, default=own[0])
        times = sorted(point.median_s for point in own)
        evaluations.append(
            MethodEvaluation(
                method=method,
                setting=setting,
                median_s=times[len(times) // 2],
                slowest_s=times[-1],
                error=worst.error if valid else math.inf,
                worst_case=worst.case,
                cases=len(own),
                outside=tuple(point.case for point in own if not point.in_range),
                wrong=tuple(point.case for point in inside if not point.error <= allowed),
                points=tuple(own),
            )
        )
    return evaluations


def choose(evaluations: Sequence[MethodEvaluation]) -> MethodEvaluation:
    """Return the fastest method that meets the tolerance over the working range.

    If several methods are equally fast, the most accurate method is returned. If no method is
    sufficient, the method that is valid in the most cases is returned.
    """
    sufficient = [one for one in evaluations if one.meets]
    if not sufficient:
        return min(evaluations, key=_miss_key)
    fastest_s = min(one.median_s for one in sufficient)
    equal = [one for one in sufficient if one.median_s <= TIE_RATIO * fastest_s]
    return min(equal, key=lambda one: (one.error, one.median_s))


def _miss_key(one: MethodEvaluation) -> tuple[int, int, float, float]:
    """Return a sort key that orders insufficient methods from the best to the worst.

    The first criterion is the number of cases outside the range in which the method is valid.
    Further criteria are the number of all failed cases, the error, and the time.
    """
    return len(one.outside), one.missed, one.error, one.median_s


def tune(
    scene: Scene,
    tunables: Sequence[Tunable],
    *,
    margin: float = MARGIN,
    progress: Callable[[str], None] = lambda text: None,
) -> list[Choice]:
    """Measure interchangeable methods, and choose one method of each method family in `tunables`.

    If a method family does not support the scene's shape, mesh or sheet, an exception of this
    family is raised.

    margin: fraction of each tolerance that remains unused, as a reserve for cases that are not
        measured.
    """
    choices: list[Choice] = []
    shape: str = scene.methods.sheet_shape or "reduced_order"
    for number, tunable in enumerate(tunables, start=1):
        report = partial(_report, progress, f"{tunable.name} ({number} of {len(tunables)})")
        settings = dict(tunable.settings)
        if tunable.name == "correction":
            settings.pop("two_pass")
            settings[TWO_PASS_NAMES[shape]] = "two_pass"
        load = load_family
        if tunable.name == "tracking" and (marker := find_choice(choices, "marker")) is not None:
            load = partial(_load_tracking, noise_px=marker.chosen.error)
        choice = _tune_family(scene, tunable, settings, load, margin=margin, progress=report)
        if tunable.name == "sheet-shape":
            shape = choice.chosen.method
        choices.append(choice)
    return choices


def find_choice(choices: Sequence[Choice], family: str) -> Choice | None:
    """Return the tuning result of a method family, or None if the family was not tuned."""
    return next((one for one in choices if one.family == family), None)


def _load_tracking(path: str, *, noise_px: float) -> Family:
    from flexsheet.launch.methods.benchmarks import make_finger_motions
    from flexsheet.nodes.triangulator.tracking_benchmark import make_tracking_family

    if not math.isfinite(noise_px):
        return load_family(path)
    return make_tracking_family(make_finger_motions, noise_px)


def _report(progress: Callable[[str], None], where: str, text: str) -> None:
    progress(f"{where}: {text}")


def _tune_family(
    scene: Scene,
    tunable: Tunable,
    settings: Mapping[str, Setting],
    load: Callable[[str], Family],
    *,
    margin: float,
    progress: Callable[[str], None],
) -> Choice:
    evaluations: list[MethodEvaluation] = []
    for path in tunable.families:
        family = load(path)
        known = {one.method for one in evaluations}
        left = {
            name: setting
            for name, setting in settings.items()
            if name in family.methods and name not in known
        }
        if not left:
            continue
        progress(f"measuring {', '.join(left)}")
        select = partial(_is_selected, left)
        points = measure_family(family, scene, repeats=REPEATS, progress=progress, select=select)
        evaluations += evaluate_methods(
            points, left, tolerance=family.tolerance(scene), margin=margin
        )
        if any(one.meets for one in evaluations):
            break
    tolerance = family.tolerance(scene)
    return Choice(
        tunable.name, tunable.key, family.unit, tolerance, choose(evaluations), tuple(evaluations)
    )


def _is_selected(methods: Mapping[str, Setting], trial: Trial) -> bool:
    return trial.in_scene and trial.method in methods


METHODS = "methods"
HEAD, UNMET_END = "# Chosen by `flexsheet tune`", "See docs/tune.md."
"""The start of the generated comment, and the end of the comment's line about unmet tolerances."""


def insert_choices(
    text: str,
    choices: Sequence[Choice],
    *,
    today: str,
    machine: str,
    commit: str | None,
    unmet: str = "",
) -> str:
    """Return the text of a scene file with the chosen methods inserted in its mapping `methods`.

    All other text is unchanged, including methods for which no choice is given. If `methods` is a
    mapping on one line, it is expanded to several lines. A comment before the mapping states the
    origin of the choices.

    choices: chosen methods.
    today, machine, commit: date, computer and git commit for the comment.
    unmet: sentences for the comment that describe exceeded tolerances, or an empty text.
    """
    lines = text.splitlines(keepends=True)
    ending = "\r\n" if lines and lines[0].endswith("\r\n") else "\n"
    block = _find_block(text, lines)
    chosen = {choice.key: choice for choice in choices}
    code = "" if commit is None else f"; code {commit[:10]}"
    head = f"{HEAD} on {today}; {machine}{code}.{ending}"
    if unmet:
        head += f"# {unmet} {UNMET_END}{ending}"
    new = [head, block.header or f"{METHODS}:{ending}"]
    for key, own in block.parts:
        if key in chosen:
            new.append(_make_line(chosen.pop(key), block.indent) + ending)
        else:
            new += [line if line.endswith("\n") else line + ending for line in own]
    new += [
        _make_line(chosen[one.key], block.indent) + ending for one in TUNABLES if one.key in chosen
    ]
    before, after = lines[: block.start], lines[block.end :]
    if before and not before[-1].endswith("\n"):
        before[-1] += ending
    if block.start == len(lines) and before and before[-1].strip():
        before.append(ending)
    return "".join([*before, *new, *after])


def _make_line(choice: Choice, indent: str) -> str:
    setting = choice.chosen.setting
    took, allowed = (
        format_duration(choice.chosen.median_s),
        f"{_format(choice.tolerance)} {choice.unit}",
    )
    comment = f"{took}, error {_format(choice.chosen.error)}"
    comment += f" {choice.unit}" if choice.composed else f", tolerance {allowed}"
    if not choice.met:
        comment += f", not met in {choice.chosen.missed} of {choice.chosen.cases} cases"
    return f"{indent}{choice.key}: {_format_flow(setting)}  # {comment}"


@dataclass(frozen=True, slots=True)
class _Block:
    """The block `methods` of a scene file, with the indices of its lines.

    start: first line of the block or of the generated comment above the block.
    end: line after the block. If the file has no such block, `start` and `end` are the end of the
        file.
    header: the line `methods:` if it can be reused, otherwise empty.
    parts: key and lines of each method family, in order. The key of a comment is empty.
    """

    start: int
    end: int
    header: str = ""
    indent: str = "  "
    parts: tuple[tuple[str, list[str]], ...] = ()


def _find_block(text: str, lines: Sequence[str]) -> _Block:
    tree = YAML(typ="rt", pure=True).load(text)
    names = list(tree)
    if METHODS not in names:
        return _Block(len(lines), len(lines))
    start = first = tree.lc.data[METHODS][0]
    later = [tree.lc.data[name][0] for name in names if tree.lc.data[name][0] > start]
    end = min(later, default=len(lines))
    while end > start + 1 and (not lines[end - 1].strip() or lines[end - 1].startswith("#")):
        end -= 1
    unmet = start > 1 and lines[start - 1].rstrip().endswith(UNMET_END)
    head = start - 2 if unmet else start - 1
    if head >= 0 and lines[head].startswith(HEAD):
        start = head
    inner = tree[METHODS]
    if not isinstance(inner, CommentedMap):
        return _Block(start, end, parts=(("", list(lines[first + 1 : end])),))
    if inner.fa.flow_style():
        unfolded = ((name, [f"  {name}: {_format_flow(item)}"]) for name, item in inner.items())
        return _Block(start, end, parts=tuple(unfolded))
    positions = {name: tuple(inner.lc.data[name][:2]) for name in inner}
    starts = sorted(line for line, _ in positions.values())
    parts = [("", list(lines[first + 1 : starts[0]]))]
    for name, (line, _) in sorted(positions.items(), key=lambda item: item[1]):
        own = list(lines[line : min((one for one in starts if one > line), default=end)])
        after: list[str] = []
        while len(own) > 1 and (not own[-1].strip() or own[-1].lstrip().startswith("#")):
            after.insert(0, own.pop())
        parts += [(name, own), ("", after)]
    indent = " " * min(column for _, column in positions.values())
    return _Block(start, end, lines[first], indent, tuple(parts))


def _format_flow(item: Any) -> str:
    if isinstance(item, Mapping):
        return (
            "{" + ", ".join(f"{name}: {_format_flow(value)}" for name, value in item.items()) + "}"
        )
    return "null" if item is None else str(item)


FILES = (("object", "geometry", "file"), ("object", "appearance", "image_file"))
"""The keys of a scene file whose values are paths relative to the file's folder."""


def relocate_paths(text: str, source: Path, target: Path) -> str:
    """Return the text of a scene file with its relative paths changed for use in another folder.

    source: scene file that contains the text.
    target: file to which the text will be written. The relative paths in the result are valid in
        its folder.

    Raises BadInputError if a path in the text cannot be replaced.
    """
    here, there = source.absolute().parent.resolve(), target.resolve().parent
    if here == there or source.resolve() == target.resolve():
        return text
    tree = YAML(typ="rt", pure=True).load(text)
    lines = text.splitlines(keepends=True)
    for key in FILES:
        holder: Any = tree
        for part in key[:-1]:
            holder = holder.get(part) if isinstance(holder, CommentedMap) else None
        name = holder.get(key[-1]) if isinstance(holder, CommentedMap) else None
        if not isinstance(name, str) or os.path.isabs(name):
            continue
        line, column = holder.lc.value(key[-1])
        rest = lines[line][column:]
        old = next((one for one in (f'"{name}"', f"'{name}'", name) if rest.startswith(one)), None)
        if old is None:
            what = f'contains "{name}", which cannot be made relative to {there}'
            remedy = "give the absolute path, or an --output file in the scene's folder"
            raise BadInputError.single(f"{source}:{line + 1}", key, what, remedy)
        new = json.dumps(os.path.relpath(here / name, there), ensure_ascii=False)
        lines[line] = lines[line][:column] + new + rest[len(old) :]
    return "".join(lines)


def check_target(source: Path, target: Path) -> None:
    """Raise BadInputError if the output file `target` cannot be written.

    The check runs before a long measurement, so that the result of the measurement is not lost.
    """
    relocate_paths(_read(source), source, target)
    try:
        if target.is_dir():
            raise IsADirectoryError(errno.EISDIR, "is a folder")
        draft = _draft_path(target.resolve())
        draft.touch()
        draft.unlink()
    except OSError as error:
        raise _write_problem(target, error) from error


def _write_problem(target: Path, error: OSError) -> BadInputError:
    if error.errno in DISK_ERRORS:
        text = str(make_write_error(target, error))
        return BadInputError.single(text, (), "the file is unchanged")
    what = f"cannot be written: {error.strerror or error}"
    remedy = "give --output FILE in an existing, writable folder"
    return BadInputError.single(str(target), (), what, remedy)


def _read(source: Path) -> str:
    return source.read_bytes().decode("utf-8")  # read_text would change line endings


def _draft_path(target: Path) -> Path:
    return target.with_name(f".{target.stem}.{os.getpid()}.yaml")


def write_choices(source: Path, target: Path, choices: Sequence[Choice], unmet: str = "") -> None:
    """Write the choices atomically into a scene file or into a copy of it.

    source: scene file.
    target: file to write. If it is a symbolic link, the file to which the link points is written.
    unmet: sentences for the generated comment about tolerances that are not met.

    Raises BadInputError if other parts of the scene would change, or if the target cannot be
    written.
    """
    text = insert_choices(
        relocate_paths(_read(source), source, target),
        choices,
        today=datetime.now(UTC).date().isoformat(),
        machine=machine_name(),
        commit=git_commit(),
        unmet=unmet,
    )
    before = load_scene(source)
    # Write the draft to the target's folder, since paths in a scene are relative to its folder.
    path = target.resolve()
    draft = _draft_path(path)
    try:
        draft.write_bytes(text.encode())
        after = _load_draft(draft, source)
        same = {"methods": before.methods}
        if after.model_copy(update=same).model_dump_json() != before.model_dump_json():
            what = "inserting the choices would change other parts of the scene"
            raise BadInputError.single(str(source), (METHODS,), what, "edit the file manually")
        shutil.copymode(path if path.exists() else source, draft)
        draft.replace(path)
    except OSError as error:
        raise _write_problem(target, error) from error
    finally:
        draft.unlink(missing_ok=True)


def _load_draft(draft: Path, source: Path) -> Scene:
    """Load a temporary copy of a scene file, into which the chosen methods have been inserted.

    Error texts name the user's scene file `source` instead of the temporary copy.
    """
    try:
        return load_scene(draft)
    except BadInputError as error:
        what = "with the choices inserted: "
        problems = [
            Problem(str(source), one.key, what + one.what, one.remedy) for one in error.problems
        ]
        raise BadInputError(problems) from error
