"""Test that the figures of the pages are those of the recorded results."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.record import record
from flexsheet.launch.experiments.offline import Metric, metric_tolerances
from flexsheet.nodes.twin.tolerance_table import Profile
from tests.doc_pages import DOCS, ROOT, name, pages
from tests.scenes import load_cylinder
from website.figures import FIGURE, RESULTS, FigureError, strip, update

NUMBER = re.compile(r"(?<![\w.])\d+\.\d+")
PAGE = "error 0.04<!-- =stroke:error.mean_m*1000 --> mm at −5<!-- =stroke:rows[deg=3].at -->\n"


def write_result(folder: Path, **changed: object) -> None:
    values = {"error": {"mean_m": 1.234e-3}, "rows": [{"deg": 1, "at": 2}, {"deg": 3, "at": -7}]}
    text = json.dumps({"results": values | changed})
    (folder / "stroke.json").write_text(text)


def test_figures_are_written_with_the_decimals_of_the_page(tmp_path: Path) -> None:
    write_result(tmp_path)
    updated = update(PAGE, tmp_path)
    assert strip(updated) == "error 1.23 mm at −7\n"
    assert update(updated, tmp_path) == updated


@pytest.mark.parametrize(
    ("changed", "wrong"),
    [
        ({"error": {}}, "exactly one value error.mean_m"),
        ({"error": {"mean_m": "1"}}, "is not a number"),
        ({"rows": []}, r"exactly one value rows\[deg=3\].at"),
    ],
)
def test_a_figure_without_a_result_is_an_error(
    tmp_path: Path, changed: dict[str, object], wrong: str
) -> None:
    write_result(tmp_path, **changed)
    with pytest.raises(FigureError, match=wrong):
        update(PAGE, tmp_path)


def test_a_result_that_was_not_recorded_is_named(tmp_path: Path) -> None:
    with pytest.raises(FigureError, match=r"benchmarks\.record stroke"):
        update(PAGE, tmp_path)


@pytest.mark.parametrize("page", pages(), ids=name)
def test_figures_of_pages_are_those_of_the_results(page: Path) -> None:
    text = page.read_text()
    assert update(text) == text, "run: make pages"


def test_tolerances_of_laboratories_are_those_of_the_scene_and_of_the_report() -> None:
    limits = metric_tolerances(load_cylinder())
    head, _, *rows = (
        [cell.strip() for cell in line.split("|")]
        for line in (DOCS / "robustness.md").read_text().splitlines()
        if line.startswith("|")
    )
    column, metrics = head.index("tolerance"), set()
    for row in rows:
        figure = FIGURE.match(row[column])
        assert figure is not None, row[column]
        *_, metric, key = figure["path"].split(".")
        assert key == "tolerance"
        assert float(figure["shown"]) == limits[Metric(metric)]
        metrics.add(Metric(metric))
    assert metrics == set(limits)


def test_commissioning_states_how_often_predicted_limits_are_met() -> None:
    stated = {
        (figure["file"], figure["path"])
        for figure in FIGURE.finditer((DOCS / "commission.md").read_text())
    }
    path = "commissioning.predictions.sheet_mm.covered"
    for profile in Profile:
        assert (f"robustness-commissioned-{profile}", path) in stated


@pytest.mark.parametrize("page", [ROOT / "README.md", DOCS / "results.md"], ids=name)
def test_tables_of_results_contain_no_other_figures(page: Path) -> None:
    """The columns of targets are excluded, because a target is not measured."""
    free: set[int] = set()
    for line in page.read_text().splitlines():
        if not line.startswith("|"):
            free = set()
            continue
        cells = line.split("|")
        targets = {index for index, cell in enumerate(cells) if cell.strip() == "target"}
        free = free or {1, *targets}
        measured = " ".join(cell for index, cell in enumerate(cells) if index not in free)
        without = re.sub(r"`[^`]*`", "", FIGURE.sub("", measured))
        assert not NUMBER.search(without), f"{name(page)}: {without}"


def test_each_result_names_its_command_machine_and_date() -> None:
    for file in RESULTS.glob("*.json"):
        result = json.loads(file.read_text())
        assert {"command", "machine", "code", "date", "results"} <= set(result), file.name


def test_the_output_of_a_command_is_recorded(tmp_path: Path) -> None:
    command = [sys.executable, "-c", 'print(\'{"rows": [{"deg": 3, "at": 1}]}\')']
    path = record("stroke", command, tmp_path)
    written = json.loads(path.read_text())
    assert written["results"] == {"rows": [{"deg": 3, "at": 1}]}
    assert set(written) == {"command", "machine", "load", "code", "date", "results"}


def test_a_measurement_that_exceeds_a_limit_is_recorded(tmp_path: Path) -> None:
    path = record("load", [sys.executable, "-c", "print('{}'); exit(1)"], tmp_path)
    assert json.loads(path.read_text())["results"] == {}
    with pytest.raises(subprocess.CalledProcessError):
        record("load", [sys.executable, "-c", "print('{}'); exit(2)"], tmp_path)
    with pytest.raises(json.JSONDecodeError):
        record("load", [sys.executable, "-c", "exit(1)"], tmp_path)
