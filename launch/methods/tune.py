"""Measure methods for a scene, choose the fastest sufficient ones, and write them into the scene.

Each family is measured on this machine over the scene's working range.  A method is sufficient if
its stated range contains the working range and its maximum error keeps a margin to the scene's
tolerance.  Without a sufficient method, the nearest miss is chosen and reported.
"""

from __future__ import annotations

import errno
import json
import math
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap

from flexsheet.launch.methods.charts import duration, git_commit, load_family, measure_family
from flexsheet.launch.methods.results import machine_name
from flexsheet.launch.plans.documents import BadInputError, Problem, did_you_mean
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.files import DISK_ERRORS, write_error
from flexsheet.messages.scene import Scene
from flexsheet.nodes.methods import Family, Point, Trial

REPEATS = 10
MARGIN = 0.2
"""Fraction of a tolerance that must remain, for errors outside the measurements."""
TIE_RATIO = 1.1
"""Methods up to this factor slower than the fastest count as equally fast; the most exact is
chosen."""

Measure = Callable[[Family, Scene, Callable[[Trial], bool]], Sequence[Point]]
Setting = str | dict[str, Any]


class UnknownTunableError(FlexsheetError, KeyError):
    """Raised for a family without a choice in scenes; the text lists the others."""

    code = "unknown-tunable"
    remedy = "Choose one of the names in the text (docs/tune.md)."


@dataclass(frozen=True, slots=True)
class Tunable:
    """Describe a family among whose methods a scene can choose.

    key: in a scene's `methods`.  families: as `module:NAME`, measured in order; later ones take
    minutes to prepare and are measured only if no earlier method is sufficient.  settings: the
    scene's value for each method, by the method's name in the chart.
    """

    name: str
    key: str
    families: tuple[str, ...]
    settings: Mapping[str, Setting]


def _by_name(*names: str) -> dict[str, Setting]:
    return {name: name for name in names}


def _soft_body(method: str, skin_spacing_m: float) -> Setting:
    return {"method": method, "skin_spacing_m": skin_spacing_m}


TUNABLES = (
    Tunable(
        "marker",
        "marker",
        ("flexsheet.nodes.triangulator.benchmarks:MARKER",),
        _by_name("moments", "weighted_centroid", "subpixel_fit"),
    ),
    Tunable(
        "triangulation",
        "triangulation",
        ("flexsheet.nodes.triangulator.benchmarks:TRIANGULATION",),
        _by_name("dlt"),
    ),
    Tunable(
        "tracking",
        "tracking",
        ("flexsheet.launch.methods.benchmarks:TRACKING",),
        _by_name("none", "one_euro", "adaptive"),
    ),
    Tunable(
        "sheet-force",
        "sheet_force",
        (
            "flexsheet.launch.methods.benchmarks:SHEET_LAWS",
            "flexsheet.launch.methods.benchmarks:SHEET_FORCE",
        ),
        _by_name("linear", "scaled", "table"),
    ),
    Tunable(
        "sheet-shape",
        "sheet_shape",
        (
            "flexsheet.launch.methods.benchmarks:QUICK_SHAPE",
            "flexsheet.launch.methods.benchmarks:SHEET_SHAPE",
        ),
        _by_name("four_triangles", "reduced_order"),
    ),
    Tunable(
        "correction",
        "correction",
        (
            "flexsheet.launch.methods.benchmarks:QUICK_CORRECTION",
            "flexsheet.launch.methods.benchmarks:CORRECTION",
        ),
        _by_name("none", "one_plane", "four_triangles", "two_pass"),
    ),
    Tunable(
        "soft-body",
        "soft_body",
        (
            "flexsheet.nodes.fem_solver.benchmarks:SOFT_BODY_LINEAR",
            "flexsheet.nodes.fem_solver.benchmarks:SOFT_BODY_TABLES",
        ),
        {
            "linear, coarse": _soft_body("linear", 0.006),
            "linear, medium": _soft_body("linear", 0.0045),
            "linear, fine": _soft_body("linear", 0.003),
            "nonlinear table, medium": _soft_body("nonlinear_table", 0.0045),
        },
    ),
)
"""In the order of tuning: the correction depends on the chosen sheet shape."""

TWO_PASS_ONTO = {
    "four_triangles": "two_pass_triangles",
    "reduced_order": "two_pass",
}
"""Name of the two-pass correction in the chart, by the sheet's shape."""


def tunables_named(names: Sequence[str]) -> list[Tunable]:
    """Return the named tunables in the order of `TUNABLES`, or all; raises UnknownTunableError."""
    known = [one.name for one in TUNABLES]
    for name in names:
        if name not in known:
            raise UnknownTunableError(
                f'no node takes a choice of "{name}"; {did_you_mean(name, known)}'
            )
    return [one for one in TUNABLES if not names or one.name in names]


@dataclass(frozen=True, slots=True)
class MethodEvaluation:
    """Hold the evaluation of one method over a scene's working range.

    median_s: time of a call, median over the cases.  slowest_s: of the slowest case.  error: the
    maximum within the method's range, at `worst_case`; infinite without one.  outside: cases out of
    the method's range.  wrong: cases whose error exceeds the tolerance less its margin, or has no
    reference.
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

    @property
    def meets(self) -> bool:
        return not self.outside and not self.wrong

    @property
    def missed(self) -> int:
        return len(self.outside) + len(self.wrong)


@dataclass(frozen=True, slots=True)
class Choice:
    """Hold the chosen method of a family and the evaluations of all."""

    family: str
    key: str
    unit: str
    tolerance: float
    chosen: MethodEvaluation
    judged: tuple[MethodEvaluation, ...]

    @property
    def met(self) -> bool:
        return self.chosen.meets

    @property
    def spare_ratio(self) -> float:
        """Return the remaining fraction of the tolerance; negative if it is exceeded."""
        return 1.0 - self.chosen.error / self.tolerance

    def sentence(self) -> str:
        """Return the reason for the choice in one sentence."""
        one, unit = self.chosen, self.unit
        allowed = f"{_figure(self.tolerance)} {unit}"
        took = duration(one.median_s)
        if not self.met:
            near = f"the nearest is {one.method} ({took}): {one.missed} of {one.cases} cases missed"
            return f"{self.family}: no method keeps {allowed}; {near}, {self._shortfall(one)}"
        cheaper = [other for other in self.judged if other.median_s * TIE_RATIO < one.median_s]
        rest = "nothing is cheaper"
        if cheaper:
            nearest = min(cheaper, key=_miss_key)
            rest = f"{nearest.method} is cheaper ({duration(nearest.median_s)}), but "
            rest += self._shortfall(nearest)
        left = f"{one.method} ({took}) leaves {_figure(one.error)} of {allowed} allowed"
        return f"{self.family}: {left}; {rest}"

    def _shortfall(self, one: MethodEvaluation) -> str:
        """Return why a method is not sufficient."""
        parts = []
        if one.wrong:
            error = f"{_figure(one.error)} {self.unit} at {_case(one.worst_case)}"
            parts.append(f"leaves {error}" if math.isfinite(one.error) else "has no reference")
        if one.outside:
            parts.append(f"is out of its range at {_case(one.outside[0])}")
        return " and ".join(parts)

    def report(self) -> dict[str, Any]:
        """Return the report of `--json`."""
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
            "sentence": self.sentence(),
            "judged": [asdict(one) for one in self.judged],
        }


def _figure(value: float) -> str:
    return f"{value:.3g}"


def _case(case: Mapping[str, Any]) -> str:
    parts = (
        f"{name} {_figure(value) if isinstance(value, float) else value}"
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
    """Evaluate each method of `settings` over the scene's own cases."""
    allowed, found = (1.0 - margin) * tolerance, []
    for method, setting in settings.items():
        mine = [point for point in points if point.method == method and point.in_scene]
        if not mine:
            continue
        inside = [point for point in mine if point.in_range]
        sure = [point for point in inside if math.isfinite(point.error)]
        worst = max(sure, key=lambda point: point.error, default=mine[0])
        times = sorted(point.median_s for point in mine)
        found.append(
            MethodEvaluation(
                method=method,
                setting=setting,
                median_s=times[len(times) // 2],
                slowest_s=times[-1],
                error=worst.error if sure else math.inf,
                worst_case=worst.case,
                cases=len(mine),
                outside=tuple(point.case for point in mine if not point.in_range),
                wrong=tuple(point.case for point in inside if not point.error <= allowed),
            )
        )
    return found


def choose(judged: Sequence[MethodEvaluation]) -> MethodEvaluation:
    """Return the fastest method that meets the tolerance everywhere, else the nearest miss."""
    enough = [one for one in judged if one.meets]
    if not enough:
        return min(judged, key=_miss_key)
    quickest = min(one.median_s for one in enough)
    same = [one for one in enough if one.median_s <= TIE_RATIO * quickest]
    return min(same, key=lambda one: (one.error, one.median_s))


def _miss_key(one: MethodEvaluation) -> tuple[int, int, float, float]:
    """Return a sort key for methods that miss; cases out of range weigh most."""
    return len(one.outside), one.missed, one.error, one.median_s


def tune(
    scene: Scene,
    tunables: Sequence[Tunable],
    *,
    margin: float = MARGIN,
    measured: Measure | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> list[Choice]:
    """Measure and choose for each family in order; `measured` replaces the measurement in tests.

    Raises the errors of a family that cannot handle the scene's shape, mesh or sheet.
    """
    choices: list[Choice] = []
    shape: str = scene.methods.sheet_shape or "reduced_order"
    for number, tunable in enumerate(tunables, start=1):
        told = partial(_report, progress, f"{tunable.name} ({number} of {len(tunables)})")
        settings = dict(tunable.settings)
        if tunable.name == "correction":
            settings.pop("two_pass")
            settings[TWO_PASS_ONTO[shape]] = "two_pass"
        choice = _tune_family(
            scene, tunable, settings, margin=margin, measured=measured, progress=told
        )
        if tunable.name == "sheet-shape":
            shape = choice.chosen.method
        choices.append(choice)
    return choices


def _report(progress: Callable[[str], None], where: str, text: str) -> None:
    progress(f"{where}: {text}")


def _tune_family(
    scene: Scene,
    tunable: Tunable,
    settings: Mapping[str, Setting],
    *,
    margin: float,
    measured: Measure | None,
    progress: Callable[[str], None],
) -> Choice:
    judged: list[MethodEvaluation] = []
    for place in tunable.families:
        family = load_family(place)
        known = {one.method for one in judged}
        left = {
            name: setting
            for name, setting in settings.items()
            if name in family.methods and name not in known
        }
        if not left:
            continue
        progress(", ".join(left))
        wanted = partial(_is_wanted, left)
        if measured is not None:
            points = measured(family, scene, wanted)
        else:
            points = measure_family(
                family, scene, repeats=REPEATS, progress=progress, wanted=wanted
            )
        judged += evaluate_methods(points, left, tolerance=family.tolerance(scene), margin=margin)
        if any(one.meets for one in judged):
            break
    tolerance = family.tolerance(scene)
    return Choice(tunable.name, tunable.key, family.unit, tolerance, choose(judged), tuple(judged))


def _is_wanted(methods: Mapping[str, Setting], trial: Trial) -> bool:
    return trial.in_scene and trial.method in methods


METHODS = "methods"


def insert_choices(
    text: str, choices: Sequence[Choice], *, today: str, machine: str, commit: str | None
) -> str:
    """Return a scene file's text with these choices in its `methods`.

    All other text keeps its bytes, also the methods of other families.  A `methods` on one line is
    expanded to several.
    """
    lines = text.splitlines(keepends=True)
    ending = "\r\n" if lines and lines[0].endswith("\r\n") else "\n"
    block = _block(text, lines)
    chosen = {choice.key: choice for choice in choices}
    code = "" if commit is None else f"; code {commit[:10]}"
    head = f"# Chosen by `flexsheet tune` on {today}; {machine}{code}.{ending}"
    new = [head, block.header or f"{METHODS}:{ending}"]
    for key, own in block.parts:
        if key in chosen:
            new.append(_line(chosen.pop(key), block.indent) + ending)
        else:
            new += [line if line.endswith("\n") else line + ending for line in own]
    new += [_line(chosen[one.key], block.indent) + ending for one in TUNABLES if one.key in chosen]
    before, after = lines[: block.start], lines[block.end :]
    if before and not before[-1].endswith("\n"):
        before[-1] += ending
    if block.start == len(lines) and before and before[-1].strip():
        before.append(ending)
    return "".join([*before, *new, *after])


def _line(choice: Choice, indent: str) -> str:
    setting = choice.chosen.setting
    took, allowed = duration(choice.chosen.median_s), f"{_figure(choice.tolerance)} {choice.unit}"
    comment = f"{took}, leaves {_figure(choice.chosen.error)} of {allowed}"
    if not choice.met:
        missed = f"{choice.chosen.missed} of {choice.chosen.cases} cases missed"
        comment = f"NOT GOOD ENOUGH, the nearest miss: {comment}; {missed}"
    return f"{indent}{choice.key}: {_flow(setting)}  # {comment}"


@dataclass(frozen=True, slots=True)
class _Block:
    """Locate the `methods` in a scene file's lines.

    start: first line, including the generated comment above.  end: line after the block; both are
    the file's end without a block.  header: the line `methods:`, if it can stay.  parts: in order,
    each family's key and lines, and comments with an empty key.
    """

    start: int
    end: int
    header: str = ""
    indent: str = "  "
    parts: tuple[tuple[str, list[str]], ...] = ()


def _block(text: str, lines: Sequence[str]) -> _Block:
    tree = YAML(typ="rt", pure=True).load(text)
    names = list(tree)
    if METHODS not in names:
        return _Block(len(lines), len(lines))
    start = first = tree.lc.data[METHODS][0]
    later = [tree.lc.data[name][0] for name in names if tree.lc.data[name][0] > start]
    end = min(later, default=len(lines))
    while end > start + 1 and (not lines[end - 1].strip() or lines[end - 1].startswith("#")):
        end -= 1
    if start > 0 and lines[start - 1].startswith("# Chosen by `flexsheet tune`"):
        start -= 1
    inner = tree[METHODS]
    if not isinstance(inner, CommentedMap):
        return _Block(start, end, parts=(("", list(lines[first + 1 : end])),))
    if inner.fa.flow_style():
        unfolded = ((name, [f"  {name}: {_flow(item)}"]) for name, item in inner.items())
        return _Block(start, end, parts=tuple(unfolded))
    at = {name: tuple(inner.lc.data[name][:2]) for name in inner}
    starts = sorted(line for line, _ in at.values())
    parts = [("", list(lines[first + 1 : starts[0]]))]
    for name, (line, _) in sorted(at.items(), key=lambda item: item[1]):
        own = list(lines[line : min((one for one in starts if one > line), default=end)])
        behind: list[str] = []
        while len(own) > 1 and (not own[-1].strip() or own[-1].lstrip().startswith("#")):
            behind.insert(0, own.pop())
        parts += [(name, own), ("", behind)]
    indent = " " * min(column for _, column in at.values())
    return _Block(start, end, lines[first], indent, tuple(parts))


def _flow(item: Any) -> str:
    if isinstance(item, Mapping):
        return "{" + ", ".join(f"{name}: {_flow(value)}" for name, value in item.items()) + "}"
    return "null" if item is None else str(item)


FILES = (("object", "geometry", "file"), ("object", "appearance", "image_file"))
"""Keys of a scene file whose values are paths relative to it."""


def relocate_paths(text: str, source: Path, target: Path) -> str:
    """Return a scene file's text with its relative paths adapted to the target's folder.

    Raises BadInputError for a path that cannot be replaced.
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
            what = f'names "{name}", which cannot be rewritten relative to {there}'
            remedy = "give the absolute path, or --output a file in the scene's folder"
            raise BadInputError([Problem(f"{source}:{line + 1}", key, what, remedy)])
        new = json.dumps(os.path.relpath(here / name, there), ensure_ascii=False)
        lines[line] = lines[line][:column] + new + rest[len(old) :]
    return "".join(lines)


def check_target(source: Path, target: Path) -> None:
    """Check before the measurement that the target can be written; raises BadInputError."""
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
        return BadInputError(
            [Problem(str(write_error(target, error)), (), "the file is unchanged")]
        )
    what = f"cannot be written: {error.strerror or error}"
    remedy = "give --output FILE in an existing, writable folder"
    return BadInputError([Problem(str(target), (), what, remedy)])


def _read(source: Path) -> str:
    return source.read_bytes().decode("utf-8")  # read_text would change how lines end


def _draft_path(target: Path) -> Path:
    return target.with_name(f".{target.stem}.{os.getpid()}.yaml")


def write_choices(source: Path, target: Path, choices: Sequence[Choice]) -> None:
    """Write the choices into a scene file or a copy of it, atomically.

    A symbolic link stays; its target is written.  Raises BadInputError if the result would not be
    the same scene, or the target cannot be written.
    """
    text = insert_choices(
        relocate_paths(_read(source), source, target),
        choices,
        today=datetime.now(UTC).date().isoformat(),
        machine=machine_name(),
        commit=git_commit(),
    )
    before = load_scene(source)
    # The draft is in the target's folder, since a scene's paths are relative to its own.
    place = target.resolve()
    draft = _draft_path(place)
    try:
        draft.write_bytes(text.encode())
        after = _load_draft(draft, source)
        same = {"methods": before.methods}
        if after.model_copy(update=same).model_dump_json() != before.model_dump_json():
            problem = Problem(
                str(source), (METHODS,), "would change with the choices", "edit it by hand"
            )
            raise BadInputError([problem])
        shutil.copymode(place if place.exists() else source, draft)
        draft.replace(place)
    except OSError as error:
        raise _write_problem(target, error) from error
    finally:
        draft.unlink(missing_ok=True)


def _load_draft(draft: Path, source: Path) -> Scene:
    """Load the draft; name the source file in its problems."""
    try:
        return load_scene(draft)
    except BadInputError as error:
        what = "with the choices put in, "
        problems = [
            Problem(str(source), one.key, what + one.what, one.remedy) for one in error.problems
        ]
        raise BadInputError(problems) from error
