"""Run all calibrations of a laboratory in sequence, and store their results in one folder.

This is called commissioning (`flexsheet commission`). The folder contains the state
(`commission.json`), the calibration files, and a scene and a launch file that use the calibration
files. Each step uses the results of all earlier steps. If a step is
repeated, all later steps must therefore be run again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError
from ruamel.yaml.comments import CommentedSeq

from flexsheet.launch.plans.documents import edit_yaml, read_document
from flexsheet.launch.plans.plan import load_graph, load_scene
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.files import write_file
from flexsheet.messages.limits import LimitedModel
from flexsheet.messages.types import Side
from flexsheet.nodes import node_class
from flexsheet.nodes.twin.tolerance_table import set_value

STATE_FILE, SCENE_FILE, LAUNCH_FILE = "commission.json", "scene.yaml", "launch.yaml"
APPARATUS_FILE = "apparatus.yaml"


class CommissionError(FlexsheetError, ValueError):
    """Raised if the commissioning in a folder cannot be continued or its data are invalid."""


class StepName(StrEnum):
    """The steps of a commissioning (calibration of a whole laboratory), in their order.

    camera: intrinsics of both cameras, and the transform between them.
    arms: poses of the arm bases relative to the camera.
    edges: pose of each clamped edge of the sheet on its flange, joint offsets, and compliance of
        the flanges.
    sheet: force model of the sheet.
    projector: intrinsics and pose of the projector.
    marker: position of the marker on the finger.
    eyes: positions of the viewer's eyes.
    delays: servo lags of the arms, offset of the camera's timestamps, and latency of the projector.
    verification: errors during a stroke of the finger.
    """

    CAMERA = "camera"
    ARMS = "arms"
    EDGES = "edges"
    SHEET = "sheet"
    PROJECTOR = "projector"
    MARKER = "marker"
    EYES = "eyes"
    DELAYS = "delays"
    VERIFICATION = "verification"


STEPS = tuple(StepName)


class NodeValue(LimitedModel):
    """A measured value of a node parameter.

    The value applies to all nodes of the type `node_type`. If `side` is given, it applies only to
    the node of that arm.
    """

    node_type: str
    parameter: str
    value: float
    side: Side | None = None


class MissingQuantity(LimitedModel):
    """A quantity that a finished step could not measure, and the reason."""

    quantity: Literal["display_latency"]
    reason: str

    def describe(self) -> str:
        return f"{self.quantity} was not measured: {self.reason}"


class StepResult(LimitedModel):
    """The result of one step of a commissioning (calibration of a whole laboratory).

    residual: error of the fit in `unit`.
    advice: text that states what to do if the residual exceeds `limit`.
    uncertainty: standard deviations by name. Each name ends in the unit.
    scene_values: new values for the scene, by dotted path in the scene file.
    parameters: names of calibration files in the folder, by node parameter. Each key has the form
        "NODE_TYPE.PARAMETER".
    node_values: measured values of other node parameters.
    missing: quantities that were not measured.
    figures: other results of the step, by name.
    covariances: covariance matrices by name, for the prediction of errors.
    """

    residual: float
    unit: str
    limit: float
    advice: str
    uncertainty: dict[str, float] = Field(default_factory=dict)
    scene_values: dict[str, Any] = Field(default_factory=dict)
    parameters: dict[str, str] = Field(default_factory=dict)
    node_values: tuple[NodeValue, ...] = ()
    missing: tuple[MissingQuantity, ...] = ()
    figures: dict[str, Any] = Field(default_factory=dict)
    covariances: dict[str, list[list[float]]] = Field(default_factory=dict)

    @property
    def within_limit(self) -> bool:
        return self.residual <= self.limit


class StepRecord(LimitedModel):
    """The record of one finished or skipped step in the calibration of a laboratory."""

    name: StepName
    date: str
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    skipped_because: str | None = None
    result: StepResult | None = None


class State(LimitedModel):
    """The state of the calibration of a laboratory: input files, and finished and skipped steps."""

    version: Literal[1] = 1
    launch_file: str
    scene_file: str
    apparatus: str | None = None
    steps: dict[StepName, StepRecord] = Field(default_factory=dict)


class MissingDataError(CommissionError):
    """Raised if a step of a commissioning needs data from real devices that were not given.

    The error text states how to capture the data.
    """

    remedy = "Capture the data as the error says, and give the folder or file by --data STEP=PATH."

    def __init__(self, step: StepName, instruction: str) -> None:
        super().__init__(f"step {step}: {instruction}")
        self.step, self.instruction = step, instruction


Step = Callable[["Commissioning"], StepResult]


@dataclass(slots=True)
class Commissioning:
    """A sequence of all calibrations of one laboratory, with its state in a folder.

    If the folder contains a state, the sequence continues from this state.

    launch_file, scene_file: launch file and scene from before the commissioning.
    apparatus: true parameters of a simulated laboratory, as given by --apparatus; None for real
        devices.

    Raises CommissionError if the folder contains other data, or a commissioning that was started
    with other files.
    """

    folder: Path
    launch_file: Path
    scene_file: Path
    apparatus: str | None
    state: State = field(init=False)

    def __post_init__(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        given = State(
            launch_file=str(self.launch_file.resolve()),
            scene_file=str(self.scene_file.resolve()),
            apparatus=self.apparatus,
        )
        self.state = self._load_state() or given
        for key in ("launch_file", "scene_file", "apparatus"):
            before, now = getattr(self.state, key), getattr(given, key)
            if before != now:
                raise CommissionError(
                    f"{self.folder / STATE_FILE}: {key}: the commissioning in this folder uses "
                    f"{before}, but the command names {now}; name the same file or value, or a new "
                    "folder"
                )

    def _load_state(self) -> State | None:
        path = self.folder / STATE_FILE
        if not path.exists():
            if any(self.folder.iterdir()):
                raise CommissionError(
                    f"{self.folder}: the folder is not empty and has no {STATE_FILE}; give a new "
                    "or empty folder"
                )
            return None
        try:
            return State.model_validate_json(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, ValidationError) as error:
            raise CommissionError(
                f"{path}: not a valid commissioning state file: {error}; use a new folder"
            ) from error

    @property
    def scene_copy(self) -> Path:
        """Return the path of the scene file that contains the results of all finished steps."""
        return self.folder / SCENE_FILE

    @property
    def launch_copy(self) -> Path:
        """Return the path of the launch file that contains the results of all finished steps."""
        return self.folder / LAUNCH_FILE

    def find_file(self, name: str) -> Path | None:
        """Return the path of a calibration file, or None if no finished step has written it."""
        used = [value for one in self._results() for value in one.parameters.values()]
        return self.folder / name if name in used else None

    def _results(self) -> Iterator[StepResult]:
        for name in STEPS:
            record = self.state.steps.get(name)
            if record is not None and record.result is not None:
                yield record.result

    def pending(self) -> list[StepName]:
        """Return the names of the steps that are neither finished nor skipped."""
        return [name for name in STEPS if name not in self.state.steps]

    def skip(self, name: StepName, reason: str) -> None:
        """Mark a step as skipped, and discard the results of all later steps."""
        self._invalidate_from(name)
        self._record(StepRecord(name=name, date=_now(), skipped_because=reason))

    def run(self, name: StepName, step: Step) -> StepResult:
        """Run a step with the results of all earlier steps, and return its result.

        The results of all later steps are discarded.
        """
        self._invalidate_from(name)
        started_s, cpu_started_s = time.monotonic(), time.process_time()
        result = step(self)
        seconds, cpu_seconds = time.monotonic() - started_s, time.process_time() - cpu_started_s
        self._record(
            StepRecord(
                name=name, date=_now(), seconds=seconds, cpu_seconds=cpu_seconds, result=result
            )
        )
        return result

    def _invalidate_from(self, name: StepName) -> None:
        done = [later for later in STEPS[STEPS.index(name) :] if later in self.state.steps]
        for later in done:
            del self.state.steps[later]
        if done or not self.scene_copy.exists():
            self.write()

    def _record(self, record: StepRecord) -> None:
        self.state.steps[record.name] = record
        self.write()

    def write(self) -> None:
        """Write the state, the scene and the launch file to the folder."""
        self._write_scene()
        self._write_launch_file()
        write_file(self.folder / STATE_FILE, self.state.model_dump_json(indent=1))

    def _write_scene(self) -> None:
        values: dict[str, Any] = {}
        for result in self._results():
            values |= result.scene_values
        with edit_yaml(self.scene_file, self.scene_copy) as tree:
            for path, value in values.items():
                set_value(tree, path, _make_yaml(value))
            for section, key in (("geometry", "file"), ("appearance", "image_file")):
                part = tree["object"].get(section, {})
                if key in part:
                    part[key] = str((self.scene_file.parent / part[key]).resolve())
        load_scene(self.scene_copy)

    def _write_launch_file(self) -> None:
        graph = load_graph(self.launch_file)
        measured: dict[str, str] = {}
        values: list[NodeValue] = []
        for result in self._results():
            measured |= result.parameters
            values += result.node_values
        with edit_yaml(self.launch_file, self.launch_copy) as tree:
            tree["scene"] = SCENE_FILE
            for name, spec in tree["nodes"].items():
                if name not in graph.nodes:
                    continue
                given = spec.get("parameters", {})
                for parameter in given:
                    given[parameter] = graph.nodes[name].parameters[parameter]
                for key, value in measured.items():
                    kind, _, parameter = key.partition(".")
                    if issubclass(node_class(graph.nodes[name].type), node_class(kind)):
                        spec.setdefault("parameters", {})[parameter] = value
                for one in values:
                    node = graph.nodes[name]
                    same = issubclass(node_class(node.type), node_class(one.node_type))
                    if same and one.side in (None, node.parameters.get("side")):
                        spec.setdefault("parameters", {})[one.parameter] = one.value
        read_document(self.launch_copy)


def _make_yaml(value: Any) -> Any:
    """Return a value for a YAML document in which each list is on one line."""
    if not isinstance(value, list):
        return value
    row = CommentedSeq([_make_yaml(one) for one in value])
    row.fa.set_flow_style()
    return row


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def summarize(lab: Commissioning) -> dict[str, Any]:
    """Return the state of a laboratory's calibration for `flexsheet commission --json`."""
    steps = []
    for record in (lab.state.steps[name] for name in StepName if name in lab.state.steps):
        row = dict.fromkeys(("residual", "unit", "limit", "within_limit", "advice"))
        row |= {"uncertainty": {}, "missing": []}
        if (result := record.result) is not None:
            shown = {"residual", "unit", "limit", "uncertainty", "missing"}
            row = result.model_dump(mode="json", include=shown)
            row["within_limit"] = result.within_limit
            row["advice"] = None if result.within_limit else result.advice
        shown = {"name", "seconds", "cpu_seconds", "skipped_because"}
        steps.append({**record.model_dump(mode="json", include=shown), **row})
    verified = lab.state.steps.get(StepName.VERIFICATION)
    found = None if verified is None or verified.result is None else verified.result.figures
    apparatus = lab.folder / APPARATUS_FILE
    return {
        "launch_file": str(lab.launch_copy),
        "scene_file": str(lab.scene_copy),
        "apparatus": str(apparatus) if apparatus.exists() else None,
        "steps": steps,
        "verification": found or {},
        "complete": not lab.pending(),
    }


def _verification_figures(state: State) -> Mapping[str, Any]:
    record = state.steps.get(StepName.VERIFICATION)
    return {} if record is None or record.result is None else record.result.figures


def format_verdict(state: State) -> list[str]:
    """Return lines of text that state whether the display errors are within all tolerances.

    If this is in doubt, each reason for doubt follows on a line of its own. If the verification is
    neither finished nor skipped, the result is empty.
    """
    record = state.steps.get(StepName.VERIFICATION)
    if record is None:
        return []
    if record.result is None:
        return [f"The laboratory was not verified: {record.skipped_because}."]
    figures = record.result.figures
    doubts = figures.get("doubts", [])
    if not doubts:
        return ["The laboratory is good: all errors are expected within tolerance."]
    lines = ["The laboratory is not good:", *(f"- {one}" for one in doubts)]
    return lines


def is_good(state: State) -> bool:
    """Return whether the display errors in a laboratory are verified to be within the tolerances.

    The verification must be finished. The function `list_doubts` must also have found no reason why
    an error may exceed a tolerance.
    """
    figures = _verification_figures(state)
    return bool(figures) and not figures.get("doubts")


def list_doubts(
    steps: Mapping[StepName, StepRecord],
    figures: Mapping[str, Any],
    tracking: tuple[float, float],
) -> list[str]:
    """Return the reasons why the display errors in a laboratory may exceed a tolerance.

    The list is empty if there are no reasons.

    figures: results of the step "verification".
    tracking: mean measured error (mm) of the sheet while it follows a stroke of the finger, and the
        tolerance (mm) of this error.
    """
    doubts = []
    if figures.get("overloaded"):
        doubts.append(
            "the computer was overloaded during the verification; repeat it on an idle computer "
            "(--step verification)"
        )
    for name, record in steps.items():
        if name is StepName.VERIFICATION:
            continue
        if record.result is None:
            doubts.append(f"step {name} was skipped: {record.skipped_because}")
            continue
        doubts += [f"step {name}: {one.describe()}" for one in record.result.missing]
        if not record.result.within_limit:
            doubts.append(
                f"step {name}: residual {record.result.residual:.3g} {record.result.unit}, limit "
                f"{record.result.limit:g} {record.result.unit}"
            )
    doubts += [
        f"predicted {metric}: 95 % are below {one['limit_95']:.3g}, tolerance "
        f"{one['tolerance']:.3g}"
        for metric, one in figures["predicted"].items()
        if not one["within"]
    ]
    doubts += [f"a self-check suspects: {cause}" for cause in figures["flagged"]]
    if tracking[0] > tracking[1]:
        doubts.append(
            f"the devices report an error of the sheet of {tracking[0]:.3g} mm, tolerance "
            f"{tracking[1]:.3g} mm"
        )
    return doubts
