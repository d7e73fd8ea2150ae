"""The triangulator's method families: how fast, how accurate, where each breaks.

A method is timed on what the node does with one pair of pictures, and judged on many.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from messages.scene import Scene
from nodes.methods import Case, Family, Trial
from nodes.models import rigid
from nodes.triangulator.mark import MARK_METHODS, MarkLooks, find_marks
from nodes.triangulator.triangulation import (
    TRIANGULATION_METHODS,
    StereoGeometry,
    covariance_in_left,
)

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]

CASE_POINTS = 2000
NOISES_PX = (0.01, 0.025, 0.1)
BASELINES_M = (0.06, 0.1205, 0.24)
MARK_NOISE_PX = MARK_METHODS["weighted_centroid"].noise_px


def _triangulation_trials(scene: Scene) -> Iterator[Trial]:
    """Points in slabs of the finger's volume, seen with pixel noise, by rigs of three baselines.

    In range is what the mark detector's noise and at least the scene's baseline give.
    """
    low, high = scene.finger.volume_min_m, scene.finger.volume_max_m
    own_m = float(np.linalg.norm(scene.camera.right_from_left[:3, 3]))
    for baseline_m in BASELINES_M:
        changed = scene.camera.right_from_left.copy()
        changed[:3, 3] *= baseline_m / own_m
        geometry = StereoGeometry.of(scene.camera.model_copy(update={"right_from_left": changed}))
        for slab in range(3):
            random = np.random.default_rng(slab)
            thickness_m = (high[2] - low[2]) / 3
            corner = np.array([low[0], low[1], low[2] + slab * thickness_m])
            size = np.array([high[0] - low[0], high[1] - low[1], thickness_m])
            truth = corner + size * random.random((CASE_POINTS, 3))
            depth_m = float(rigid.apply(geometry.left_from_world, truth)[:, 2].mean())
            pixels = geometry.project(truth)
            for noise_px in NOISES_PX:
                seen = [view + noise_px * random.standard_normal(view.shape) for view in pixels]
                case: Case = {
                    "depth_mm": round(1e3 * depth_m),
                    "noise_px": noise_px,
                    "baseline_mm": 1e3 * baseline_m,
                }
                in_range = baseline_m >= own_m and noise_px <= MARK_NOISE_PX
                for name in TRIANGULATION_METHODS:
                    yield _triangulation_trial(
                        name, case, geometry.normalize(*seen), geometry, truth, in_range=in_range
                    )


def _triangulation_trial(
    name: str,
    case: Case,
    seen: tuple[Floats, Floats],
    geometry: StereoGeometry,
    truth: Floats,
    *,
    in_range: bool,
) -> Trial:
    method, rig, (left, right) = TRIANGULATION_METHODS[name], geometry.right_from_left, seen

    def error_mm(_: Floats) -> float:
        points = rigid.apply(geometry.world_from_left, method(left, right, rig))
        return 1e3 * float(np.sqrt(np.mean(np.sum((points - truth) ** 2, axis=1))))

    return Trial(
        method=name,
        case=case,
        run=lambda: method(left[:1], right[:1], rig),
        error=error_mm,
        in_range=in_range,
    )


TRIANGULATION = Family(
    name="triangulation",
    unit="mm",
    reference="true points over the finger's volume",
    methods=tuple(TRIANGULATION_METHODS),
    trials=_triangulation_trials,
    tolerance=lambda scene: 1e3 * scene.tolerances.fingertip_m,
)

MARK_PICTURES = 200
MARK_RADII_PX = (2.0, 3.2, 6.0)
MARK_NOISES = (1.0, 3.0, 8.0)
PICTURE_PX = 57
RAYS = 8


def _mark_picture(centre: Floats, radius_px: float, noise: float, seed: int) -> Image:
    """A bright disc on even ground, each pixel lit by its covered share, with noise (levels)."""
    fine = (np.arange(PICTURE_PX * RAYS) - 0.5 * (RAYS - 1)) / RAYS
    covered = np.hypot(fine[None, :] - centre[0], fine[:, None] - centre[1]) < radius_px
    share = covered.reshape(PICTURE_PX, RAYS, PICTURE_PX, RAYS).mean(axis=(1, 3))
    level = 40.0 + 175.0 * share + np.random.default_rng(seed).normal(0.0, noise, share.shape)
    return np.asarray(np.clip(np.rint(level), 0, 255), dtype=np.uint8)


def _mark_trials(scene: Scene) -> Iterator[Trial]:
    """Discs all over the pixel grid; a mark of 3 mm radius has 3.2 px at the paper's distance."""
    for radius_px in MARK_RADII_PX:
        for noise in MARK_NOISES:
            centres = 28.0 + np.random.default_rng(1).uniform(-0.5, 0.5, (MARK_PICTURES, 2))
            pictures = [
                _mark_picture(centre, radius_px, noise, seed) for seed, centre in enumerate(centres)
            ]
            for name in MARK_METHODS:
                case: Case = {"radius_px": radius_px, "noise_levels": noise}
                yield _mark_trial(name, case, pictures, centres, in_range=radius_px >= 3.0)


def _mark_trial(
    name: str, case: Case, pictures: list[Image], centres: Floats, *, in_range: bool
) -> Trial:
    looks, centroid = MarkLooks(), MARK_METHODS[name].centroid

    def error_px(_: list[Floats]) -> float:
        """Per axis; a mark that was not found, or not alone, counts as far off as the picture."""
        found = [find_marks(picture, looks, centroid) for picture in pictures]
        off = [
            marks[0] - centre if len(marks) == 1 else np.full(2, float(PICTURE_PX))
            for marks, centre in zip(found, centres, strict=True)
        ]
        return float(np.sqrt(np.mean(np.square(off))))

    return Trial(
        method=name,
        case=case,
        run=lambda: find_marks(pictures[0], looks, centroid),
        error=error_px,
        in_range=in_range,
    )


def _mark_tolerance_px(scene: Scene) -> float:
    """Noise of a mark that moves a fingertip at the screen's centre by the scene's tolerance."""
    geometry = StereoGeometry.of(scene.camera)
    centre = rigid.apply(geometry.left_from_world, np.zeros(3))
    error_m_per_px = np.sqrt(np.trace(covariance_in_left(geometry, centre, 1.0)))
    return float(scene.tolerances.fingertip_m / error_m_per_px)


MARK = Family(
    name="mark",
    unit="px",
    reference="true centres of drawn discs",
    methods=tuple(MARK_METHODS),
    trials=_mark_trials,
    tolerance=_mark_tolerance_px,
)
