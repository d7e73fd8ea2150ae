"""Test the comparison with CalculiX, without the program CalculiX."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.force_reference import make_mesh, reference_pushes
from benchmarks.force_witness import (
    MESHES,
    WitnessError,
    make_finger,
    read_forces,
    solve_with_calculix,
    write_deck,
)
from tests.scenes import load_cylinder

RESULT = """
 forces (fx,fy,fz) for set NBALL and time  0.1000000E+01

 total force (fx,fy,fz) for set NBALL and time  0.1000000E+01

        1.500000E-03  2.000000E-04 -9.849771E-03

 total force (fx,fy,fz) for set NBALL and time  0.2000000E+01

        1.600000E-03  2.100000E-04 -2.440220E-02
"""


def test_the_finger_has_the_volume_of_a_sphere_and_outward_triangles() -> None:
    points, triangles = make_finger(3)
    corners = points[triangles]
    assert len(triangles) == 20 * 4**3
    assert np.linalg.det(corners).min() > 0.0
    assert np.linalg.det(corners).sum() / 6.0 == pytest.approx(4.0 * np.pi / 3.0)
    assert np.linalg.norm(points, axis=1) == pytest.approx(1.0, abs=0.01)


def test_the_deck_holds_the_support_and_moves_the_finger_by_each_depth() -> None:
    push = replace(reference_pushes(load_cylinder())[0], scale=MESHES[0])
    mesh = make_mesh(push)
    centre = np.array([0.0, 0.0, push.radius + 1.0])
    lines = write_deck(mesh, push, centre, [0.1, 0.5]).splitlines()
    assert lines.count("*END STEP") == 2
    assert [line for line in lines if line.startswith("NBALL, 3, 3,")] == [
        "NBALL, 3, 3, -0.1",
        "NBALL, 3, 3, -0.5",
    ]
    held = lines[lines.index("*BOUNDARY") + 1 : lines.index("*STEP, NLGEOM, INC=400")]
    used = np.unique(mesh.cells[:, :20])
    assert len(held) == np.count_nonzero(mesh.held[used])
    skin = lines[lines.index("*SURFACE, NAME=SKIN, TYPE=ELEMENT") + 1 :]
    touched = skin[: next(n for n, line in enumerate(skin) if line.startswith("*"))]
    assert len(touched) == len(mesh.faces)


def test_forces_are_read_from_the_totals_of_each_step() -> None:
    forces = read_forces(RESULT)
    assert np.array(forces)[:, 2] == pytest.approx([-9.849771e-3, -2.44022e-2])
    assert read_forces("") == []


def test_a_missing_program_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(WitnessError, match="calculix-ccx"):
        solve_with_calculix(reference_pushes(load_cylinder())[0], [0.1])
