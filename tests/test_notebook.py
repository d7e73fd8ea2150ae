"""Test the notebook of docs/ by running its cells on bags whose errors are known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest

from flexsheet.launch.experiments import image, stroke
from flexsheet.launch.experiments.run import (
    chain_procedures,
    make_image_procedure,
    make_path_procedure,
    make_settings,
    run_experiment,
)
from flexsheet.launch.plans.shipped import LAUNCH_FILES, find_file
from flexsheet.messages.types import Correction, TwinEye
from tests import sessions
from tests.example_bag import write_example

nbformat = pytest.importorskip("nbformat")
mpl.use("Agg")

NOTEBOOK = Path(__file__).resolve().parent.parent / "docs" / "paper-figures.ipynb"
PARAMETERS = "bags"
"""Id of the cell with the names of the bags, which a test replaces."""

METRES_PER_PX = 0.001
HEIGHT_PX, WIDTH_PX = 60, 90
EXTRA_PX: dict[Correction, int] = {
    "none": 12, "one_plane": 6, "four_triangles": 4, "two_pass": 2,
}  # fmt: skip
"""Known error of the height of the object in the pictures, by correction."""


def run_notebook(bags: list[Path], strokes_s: tuple[float, ...]) -> dict[str, Any]:
    """Run all cells of the notebook in order, as Jupyter does; return their variables."""
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    variables: dict[str, Any] = {}
    for cell in notebook.cells:
        if cell.cell_type == "code" and cell.id == PARAMETERS:
            variables |= {"BAGS": [str(bag) for bag in bags], "STROKES_S": strokes_s}
        elif cell.cell_type == "code":
            exec(compile(cell.source, f"{NOTEBOOK.name}:{cell.id}", "exec"), variables)
    variables["plt"].close("all")
    return variables


def draw_rectangle(extra_px: int) -> np.ndarray:
    picture = np.zeros((160, 200, 3), np.uint8)
    picture[40 : 40 + HEIGHT_PX + extra_px, 50 : 50 + WIDTH_PX] = 200
    return picture


def write_pictures(folder: Path) -> Path:
    """Write pictures of two angles and two depths with all corrections."""
    pictures = [
        TwinEye(label=series.label(value, correction), correction=correction,
                metres_per_px=METRES_PER_PX, seen=draw_rectangle(extra_px),
                expected=draw_rectangle(0))
        for series, values in ((image.TILT, (-10, 40)), (image.PUSH, (10, 50)))
        for value in values
        for correction, extra_px in EXTRA_PX.items()
    ]  # fmt: skip
    return write_example(folder / "eye.mcap", tuple(("twin/eye", one) for one in pictures))


def test_the_notebook_finds_the_known_errors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bags = [sessions.write_session(tmp_path / "stroke.mcap"), write_pictures(tmp_path)]
    found = run_notebook(bags, (sessions.STROKE_S, 30.0))

    assert found["table_1"].keys() == {sessions.STROKE_S}
    result = found["table_1"][sessions.STROKE_S]
    radius_m = sessions.SCENE.object.geometry.radius_m  # type: ignore[union-attr]  # a cylinder
    expected_mm = 1e3 * np.hypot(sessions.OFF_M, radius_m * sessions.TURNED_RAD)
    assert result["true_delta_d_mm"]["mean"] == pytest.approx(expected_mm, rel=0.01)
    assert result["delta_theta_deg"]["mean"] == pytest.approx(np.degrees(sessions.TURNED_RAD))

    assert {row["theta_deg"] for row in found["fig_11"]} == {-10, 40}
    assert {row["depth_mm"] for row in found["fig_13"]} == {10, 50}
    for row in (*found["fig_11"], *found["fig_13"]):
        assert row["delta_h_mm"] == pytest.approx(EXTRA_PX[row["method"]], abs=0.05)
    # The height is one of three sizes that are averaged, or of two.
    assert found["fig_11"][0]["mean_mm"] == pytest.approx(EXTRA_PX["none"] / 3, abs=0.05)
    assert found["fig_13"][0]["mean_mm"] == pytest.approx(EXTRA_PX["none"] / 2, abs=0.05)
    printed = capsys.readouterr().out
    assert "true_delta_d_mm" in printed
    assert "Fig. 13  two_pass" in printed


def test_the_notebook_is_stored_without_results() -> None:
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.id for cell in code].count(PARAMETERS) == 1
    assert all(not cell.outputs and cell.execution_count is None for cell in code)


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.timeout(900)
def test_the_notebook_reproduces_the_paper_from_a_recorded_bag(tmp_path: Path) -> None:
    demo = find_file(Path("demo"), LAUNCH_FILES)
    bag = tmp_path / "paper.mcap"
    procedure = chain_procedures(
        make_path_procedure(lambda scene: stroke.stroke_path(scene, 10.0), print),
        make_image_procedure(image.TILT, [-40], image.CORRECTIONS, print),
        make_image_procedure(image.PUSH, [30], image.CORRECTIONS, print),
    )
    settings = make_settings(demo, "planner", "compliance_mode=stiffness")
    run_experiment(demo, settings, bag, procedure, print, needed=["twin/eye"])
    found = run_notebook([bag], (10.0,))

    result, paper = found["table_1"][10.0], stroke.PAPER_TABLE_1[10.0]
    assert result["delta_d_mm"]["mean"] < paper["delta_d_mm"][0]
    assert result["delta_theta_deg"]["mean"] < paper["delta_theta_deg"][0]
    for rows in (found["fig_11"], found["fig_13"]):
        errors = {row["method"]: row["mean_mm"] for row in rows}
        assert errors["none"] > 3.0
        assert errors["two_pass"] < 0.3
