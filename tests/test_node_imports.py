"""Nodes do not import slow packages that they do not need, which would delay their restart."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from flexsheet.nodes.triangulator.data_association import assign_columns

SLOW = {"scipy.interpolate", "scipy.optimize", "scipy.stats", "matplotlib", "distributed", "typer"}


def test_nodes_that_the_arms_wait_for_import_no_slow_package() -> None:
    code = (
        "import sys\n"
        "from types import SimpleNamespace\n"
        "from flexsheet.nodes.runner import node_class\n"
        "for name in ('triangulator', 'planner', 'camera', 'arm_bridge', 'twin_arms'):\n"
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
