"""Test the calibration of the viewer's eyes from aligned beads and crosses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flexsheet.launch.calibration.eyes import (
    BEADS_M,
    COLUMNS,
    SIDES,
    Alignment,
    EyesError,
    fit_eyes,
    read_alignments,
    simulate_alignments,
)
from flexsheet.launch.plans.documents import BadInputError
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.apparatus import nominal_apparatus
from flexsheet.messages.calibration import StereoCalibration
from flexsheet.messages.scene import Eyes

ROOT = Path(__file__).resolve().parent.parent
SCENE = load_scene(ROOT / "launch" / "scenes" / "cylinder.yaml")
OPTICS = StereoCalibration.load(ROOT / "launch" / "calibrations" / "twin-bumblebee.yaml")
TRUE = Eyes(centre_world_m=np.array([0.012, -0.008, 0.43]), interocular_m=0.061)


def align(noise_rad: float = 0.0, seed: int = 1) -> list[Alignment]:
    """Return alignments of the true eyes with crosses on the plane z = 0."""
    random = np.random.default_rng(seed)
    found = []
    for sign, side in zip((-0.5, 0.5), SIDES, strict=True):
        eye = TRUE.centre_world_m + np.array([sign * TRUE.interocular_m, 0.0, 0.0])
        for bead in np.array(BEADS_M):
            ray = bead - eye
            cross = eye - ray * eye[2] / ray[2]
            cross[:2] += random.normal(0.0, noise_rad * eye[2], 2)
            found.append(Alignment(side, bead, cross))
    return found


def test_exact_alignments_give_the_exact_eyes() -> None:
    found = fit_eyes(align(), SCENE.eyes)
    assert found.eyes.centre_world_m == pytest.approx(TRUE.centre_world_m, abs=1e-7)
    assert found.eyes.interocular_m == pytest.approx(TRUE.interocular_m, abs=1e-7)


def test_the_stated_uncertainty_is_that_of_repeated_calibrations() -> None:
    """The squared error in units of the covariance has the mean 3, with standard error 0.39."""
    squares = []
    for seed in range(40):
        found = fit_eyes(align(1.5e-3, seed), SCENE.eyes)
        error_m = found.eyes.centre_world_m - TRUE.centre_world_m
        squares.append(float(error_m @ np.linalg.solve(found.covariance_m2, error_m)))
    assert 1.8 < np.mean(squares) < 4.6


def test_one_wrong_alignment_hardly_moves_the_eyes() -> None:
    given = align(1e-3)
    clean = fit_eyes(given, SCENE.eyes).eyes.centre_world_m
    given[4] = Alignment("left", given[4].bead_m, given[4].cross_m + np.array([0.02, 0.0, 0.0]))
    corrupted = fit_eyes(given, SCENE.eyes).eyes.centre_world_m
    assert np.linalg.norm((corrupted - clean)[:2]) < 1e-3


def test_a_simulated_viewer_is_measured_through_the_stereo_camera() -> None:
    nominal = nominal_apparatus(SCENE)
    moved = nominal.eyes.model_copy(
        update={"centre_offset_m": (0.01, -0.012, 0.02), "interocular_offset_m": -0.004,
                "sway_m": 0.004}
    )  # fmt: skip
    apparatus = nominal.model_copy(update={"eyes": moved})
    found = fit_eyes(simulate_alignments(SCENE, apparatus, calibration=OPTICS, seed=1), SCENE.eyes)
    error_m = found.eyes.centre_world_m - SCENE.eyes.centre_world_m - [0.01, -0.012, 0.02]
    assert np.abs(error_m).max() < 4.0 * np.sqrt(np.diag(found.covariance_m2)).max()
    assert np.linalg.norm(error_m[:2]) < 1.5e-3
    assert abs(error_m[2]) < 6e-3
    assert found.eyes.interocular_m == pytest.approx(0.060, abs=3e-3)


def test_alignments_are_read_from_a_file(tmp_path: Path) -> None:
    file = tmp_path / "eyes.csv"
    rows = [
        ",".join([one.eye, *(f"{1e3 * x}" for x in (*one.bead_m, *one.cross_m))]) for one in align()
    ]
    file.write_text("\n".join([",".join(COLUMNS), *rows]))
    found = fit_eyes(read_alignments(file), SCENE.eyes)
    assert found.eyes.centre_world_m == pytest.approx(TRUE.centre_world_m, abs=1e-6)


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("middle,0,0,100,0,0,0", "eye: expected left or right"),
        ("left,0,x,100,0,0,0", "bead_y_mm: expected a number"),
    ],
)
def test_bad_rows_are_refused(tmp_path: Path, row: str, words: str) -> None:
    file = tmp_path / "eyes.csv"
    file.write_text(f"{','.join(COLUMNS)}\n{row}\n")
    with pytest.raises(BadInputError, match=words):
        read_alignments(file)


def test_alignments_that_do_not_determine_the_eyes_are_refused() -> None:
    with pytest.raises(EyesError, match="there are 3 alignments of the left eye"):
        fit_eyes(align()[:3], SCENE.eyes)
    mirrored = [Alignment(one.eye, one.bead_m * [1, 1, -1], one.cross_m) for one in align()]
    with pytest.raises(EyesError, match="from its position in the scene"):
        fit_eyes(mirrored, SCENE.eyes)
    random = np.random.default_rng(1)
    scattered = [
        Alignment(one.eye, one.bead_m, one.cross_m + random.normal(0.0, [0.012, 0.012, 0.0]))
        for one in align()
    ]
    with pytest.raises(EyesError, match="mrad are allowed"):
        fit_eyes(scattered, SCENE.eyes)
    close = [Alignment(one.eye, one.cross_m + 0.01, one.cross_m) for one in align()]
    with pytest.raises(EyesError, match="less than 50 mm"):
        fit_eyes(close, SCENE.eyes)
