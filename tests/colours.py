"""Compute contrasts of colours."""

from __future__ import annotations

import numpy as np


def luminance(color: str) -> float:
    """Return the relative luminance of "#rrggbb" (WCAG 2)."""
    parts = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])
