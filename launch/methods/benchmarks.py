"""Define the method families whose errors are measured against the simulator.

This module is in the package `launch`, because only this package is allowed to import both the
methods and the simulator.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np

from flexsheet.launch.calibration.simulated_sheet import (
    make_error_function,
    simulate_force,
    simulate_points,
)
from flexsheet.launch.experiments.stroke import stroke_path
from flexsheet.messages.scene import Cylinder, Scene
from flexsheet.messages.types import FingerPath
from flexsheet.nodes.planner import force_table
from flexsheet.nodes.planner.sheet_force import sheet_force_family
from flexsheet.nodes.renderer.benchmarks import correction_family
from flexsheet.nodes.renderer.sheet_shape_benchmark import sheet_shape_family
from flexsheet.nodes.triangulator.tracking_benchmark import TruePathCase, make_tracking_family
from flexsheet.nodes.twin.finger import FingerMotion
from flexsheet.nodes.twin.gestures import GESTURES

CORRECTION = correction_family(make_error_function)
QUICK_CORRECTION = correction_family(make_error_function, solved=False)

TRACKED_GESTURES = ("hold", "reach", "tap", "stop", "stroke-push")
RESTING = ("hold",)


def make_finger_motions(scene: Scene) -> Mapping[str, TruePathCase]:
    """Return the true finger motions of the tracking benchmark, by name.

    The motions are human gestures and, if the object is a cylinder, a stroke of the finger.
    """
    paths: dict[str, FingerPath] = {}
    if isinstance(scene.object.geometry, Cylinder):
        paths["stroke"] = stroke_path(scene, 10.0)
    paths |= {name: GESTURES[name](scene) for name in TRACKED_GESTURES}
    return {
        name: _make_motion(scene, path, resting=name in RESTING) for name, path in paths.items()
    }


def _make_motion(scene: Scene, path: FingerPath, *, resting: bool) -> TruePathCase:
    """Return a finger motion, with wander and tremor, that begins at the first point of a path."""
    start = np.asarray(path.positions_world_m[0])
    motion = FingerMotion.resting(start, seed=1).followed_by(
        0.0,
        times_s=path.times_s,
        points=path.positions_world_m,
        wander_m=path.wander_m,
        tremor_m=path.tremor_m,
        max_speed_m_per_s=scene.finger.max_speed_m_per_s,
        joined_by=path.joined_by,
    )
    duration_s = float(path.times_s[-1] - path.times_s[0])
    return TruePathCase(
        lambda time_s: motion.at(motion.ease_s + time_s).position, duration_s, resting
    )


TRACKING = make_tracking_family(make_finger_motions)
compute_true_force = lru_cache(maxsize=1024)(simulate_force)
SHEET_FORCE = sheet_force_family(
    compute_true_force, lambda scene: force_table.load_or_compute(scene, None)
)
SHEET_LAWS = sheet_force_family(compute_true_force, None)
"""The method family of the sheet force models that need no long precomputation."""
SHEET_SHAPE = sheet_shape_family(simulate_points)
QUICK_SHAPE = sheet_shape_family(simulate_points, solved=False)
