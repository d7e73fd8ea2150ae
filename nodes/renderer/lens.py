"""Convert the projector's lens distortion to OpenGL clip coordinates for the shaders."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flexsheet.messages.scene import Lens

REACH_MARGIN = 1.1
"""The maximum slope at which the lens distortion must be invertible, divided by the slope at the
image's corners. The slope of a ray is the tangent of its angle to the optical axis."""


@dataclass(frozen=True, slots=True)
class ClipLens:
    """The parameters of the projector lens in OpenGL clip coordinates.

    focal_centre: focal lengths and principal point (fx, fy, cx, cy). distortion: coefficients k1,
    k2, p1, p2 and k3, as in OpenCV. reach: maximum squared slope of a ray. Steeper rays are limited
    to this slope, because the distortion polynomial would map them back into the image.
    """

    focal_centre: tuple[float, float, float, float]
    distortion: tuple[float, ...]
    reach: float


def clip_lens(lens: Lens, width_px: int, height_px: int) -> ClipLens | None:
    """Convert lens parameters to OpenGL clip coordinates.

    Return None if the lens has no distortion. Raises ValueError if the distortion is not invertible
    within the image.
    """
    if not any(lens.distortion):
        return None
    k1, k2, _, _, k3 = lens.distortion
    corners = [
        ((x - lens.cx_px) / lens.fx_px, (y - lens.cy_px) / lens.fy_px)
        for x in (-0.5, width_px - 0.5)
        for y in (-0.5, height_px - 0.5)
    ]
    # Radii r at which the radial polynomial r (1 + k1 r^2 + ...) has zero slope.
    stationary = np.roots([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])
    real = stationary[(np.abs(stationary.imag) < 1e-9) & (stationary.real > 0.0)].real
    fold = float(np.sqrt(real.min())) if len(real) else np.inf
    largest = fold * (1.0 + k1 * fold**2 + k2 * fold**4 + k3 * fold**6) if len(real) else np.inf
    needed = REACH_MARGIN * max(float(np.hypot(*corner)) for corner in corners)
    if largest < needed:
        raise ValueError(
            f"projector.lens.distortion: {lens.distortion} maps several rays to one pixel: it "
            f"is invertible up to the ray slope {largest:.3f}, but the image corners need "
            f"{needed:.3f}; calibrate the projector again with points in the whole image"
        )
    reach = min(fold, 4.0 * needed)
    return ClipLens(
        (
            2.0 * lens.fx_px / width_px,
            -2.0 * lens.fy_px / height_px,
            (2.0 * lens.cx_px + 1.0) / width_px - 1.0,
            1.0 - (2.0 * lens.cy_px + 1.0) / height_px,
        ),
        lens.distortion,
        reach**2,
    )
