"""Test that nodes do not import slow packages that they do not need."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.optimize import linear_sum_assignment

from flexsheet.nodes.triangulator.data_association import assign_columns
from flexsheet.nodes.twin.finger import SmoothPath

SLOW = {"scipy.interpolate", "scipy.optimize", "scipy.stats", "matplotlib", "distributed", "typer"}


def test_nodes_that_the_arms_wait_for_import_no_slow_package() -> None:
    code = (
        "import sys\n"
        "from types import SimpleNamespace\n"
        "from flexsheet.nodes.runner import node_class\n"
        "names = 'triangulator planner twin_finger camera arm_bridge twin_arms'\n"
        "for name in names.split():\n"
        "    node_class(name)\n"
        "parameters = SimpleNamespace(calibration=None, marker_calibration=None)\n"
        "setup = node_class('triangulator').setup(SimpleNamespace(parameters=parameters))\n"
        "try:\n"
        "    setup.send(None)\n"
        "except StopIteration:\n"
        "    print(*sys.modules)\n"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert "scipy.special" in loaded
    assert not SLOW & loaded


@pytest.mark.parametrize("seed", range(20))
def test_assignments_are_as_cheap_as_scipys(seed: int) -> None:
    random = np.random.default_rng(seed)
    rows = int(random.integers(1, 8))
    costs = random.uniform(size=(rows, rows + int(random.integers(0, 5))))
    costs += random.uniform(size=costs.shape[1]) * 3.0
    columns = assign_columns(costs)
    assert len(set(columns)) == rows
    expected = linear_sum_assignment(costs)
    assert costs[range(rows), columns].sum() == pytest.approx(costs[expected].sum())


@pytest.mark.parametrize("count", [2, 3, 50])
def test_a_finger_path_is_the_clamped_spline_of_scipy(count: int) -> None:
    random = np.random.default_rng(count)
    times, points = np.cumsum(random.uniform(0.001, 0.1, count)), random.normal(size=(count, 3))
    path, expected = (
        SmoothPath.through(times, points),
        CubicSpline(times, points, bc_type="clamped"),
    )
    for share in (0.01, 0.3, 0.99):
        at_s = share * path.duration_s
        position, velocity = path.at(at_s)
        assert position == pytest.approx(expected(times[0] + at_s), abs=1e-9)
        assert velocity == pytest.approx(expected(times[0] + at_s, 1), abs=1e-6)
