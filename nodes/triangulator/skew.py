"""Two cameras without a common trigger see a moving finger at two times; what that does, undone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nodes.triangulator.fingertip import Sighting
from nodes.triangulator.triangulation import Measured, StereoGeometry, pixel_and_slope

Floats = NDArray[np.float64]


def unskewed(
    measured: Measured,
    geometry: StereoGeometry,
    skew_s: float,
    velocity: Floats,
    velocity_covariance: Floats,
) -> Measured:
    """The point (3,) at the middle between both exposures, the right one `skew_s` after the left.

    velocity: (3,) m/s of the finger in the world, with its covariance (3, 3).  To first order a
    finger that moves at v is measured off by M v, M = s (A_r J_r - 1/2), with J_r the slope of the
    right pixel and A_r the part of the triangulation that takes it: mostly in depth, by speed times
    skew times depth over baseline.  What is not known of v adds to the covariance.
    """
    world = geometry.world_from_left[:3, :3]
    in_left = geometry.left_from_world[:3, :3] @ measured.point_world
    in_left = in_left + geometry.left_from_world[:3, 3]
    rig = geometry.right_from_left
    in_right = rig[:3, :3] @ in_left + rig[:3, 3]
    left = pixel_and_slope(in_left, geometry.matrices[0], geometry.distortions[0])[1]
    right = pixel_and_slope(in_right, geometry.matrices[1], geometry.distortions[1])[1]
    right = right @ rig[:3, :3]
    # The singular case was refused when the point was measured.
    share = np.linalg.solve(left.T @ left + right.T @ right, right.T @ right)
    off = skew_s * (world @ share @ world.T - 0.5 * np.eye(3))
    return replace(
        measured,
        point_world=measured.point_world - off @ velocity,
        covariance=measured.covariance + off @ velocity_covariance @ off.T,
    )


def sighting_unskewed(
    sighting: Sighting,
    geometry: StereoGeometry,
    skew_s: float,
    velocity: Floats,
    velocity_covariance: Floats,
) -> Sighting:
    """All that was found, each as if it were the finger; see `unskewed`."""

    def mended(measured: Measured) -> Measured:
        return unskewed(measured, geometry, skew_s, velocity, velocity_covariance)

    return replace(
        sighting,
        measured=None if sighting.measured is None else mended(sighting.measured),
        marks=tuple(replace(mark, measured=mended(mark.measured)) for mark in sighting.marks),
        others=tuple(replace(mark, measured=mended(mark.measured)) for mark in sighting.others),
    )
