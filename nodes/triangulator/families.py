"""The triangulator's method families: how fast, how accurate, where each breaks."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from messages.scene import Scene
from nodes.methods import Case, Family, Trial
from nodes.models import rigid
from nodes.triangulator.triangulation import TRIANGULATION_METHODS, StereoGeometry

Floats = NDArray[np.float64]

CASE_POINTS = 2000
NOISES_PX = (0.02, 0.1, 0.5)
BASELINES_M = (0.06, 0.1205, 0.24)


def _trials(scene: Scene) -> Iterator[Trial]:
    """Points in slabs of the finger's volume, seen with pixel noise, by rigs of three baselines."""
    low, high = scene.finger.volume_min_m, scene.finger.volume_max_m
    for baseline_m in BASELINES_M:
        wider = scene.camera.right_from_left.copy()
        wider[:3, 3] *= baseline_m / np.linalg.norm(wider[:3, 3])
        geometry = StereoGeometry.of(scene.camera.model_copy(update={"right_from_left": wider}))
        for slab in range(3):
            random = np.random.default_rng(slab)
            bottom = low[2] + slab * (high[2] - low[2]) / 3
            corner = np.array([low[0], low[1], bottom])
            size = np.array([high[0] - low[0], high[1] - low[1], (high[2] - low[2]) / 3])
            truth = corner + size * random.random((CASE_POINTS, 3))
            depth_m = float(rigid.apply(geometry.left_from_world, truth)[:, 2].mean())
            pixels = geometry.project(truth)
            for noise_px in NOISES_PX:
                seen = [view + noise_px * random.standard_normal(view.shape) for view in pixels]
                left, right = geometry.normalize(seen[0], seen[1])
                case: Case = {
                    "depth_mm": round(1e3 * depth_m),
                    "noise_px": noise_px,
                    "baseline_mm": 1e3 * baseline_m,
                    "points": CASE_POINTS,
                }
                for name in TRIANGULATION_METHODS:
                    yield _trial(name, case, (left, right), geometry, truth)


def _trial(
    name: str, case: Case, seen: tuple[Floats, Floats], geometry: StereoGeometry, truth: Floats
) -> Trial:
    def error(points_left: Floats) -> float:
        points = rigid.apply(geometry.world_from_left, points_left)
        return 1e3 * float(np.sqrt(np.mean(np.sum((points - truth) ** 2, axis=1))))

    # What a mark detector that works leaves, at the scene's own baseline or a longer one.
    own_m = float(np.linalg.norm(geometry.right_from_left[:3, 3])) >= 0.12
    return Trial(
        method=name,
        case=case,
        run=lambda: TRIANGULATION_METHODS[name](*seen, geometry.right_from_left),
        error=error,
        in_range=own_m and float(case["noise_px"]) <= 0.1,
    )


TRIANGULATION = Family(
    name="triangulation",
    unit="mm",
    reference="true points over the finger's volume",
    methods=tuple(TRIANGULATION_METHODS),
    trials=_trials,
    tolerance=lambda scene: 1e3 * scene.tolerances.fingertip_m,
)
