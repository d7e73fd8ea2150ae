"""Define the method families whose errors are measured against the simulator.

This module is in the package `launch`, because only this package is allowed to import both the
methods and the simulator.
"""

from __future__ import annotations

from flexsheet.launch.calibration.simulated_sheet import make_error_function, simulate_points
from flexsheet.nodes.renderer.benchmarks import correction_family
from flexsheet.nodes.renderer.sheet_shape_benchmark import sheet_shape_family

CORRECTION = correction_family(make_error_function)
SHEET_SHAPE = sheet_shape_family(simulate_points)
