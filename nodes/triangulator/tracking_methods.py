"""List the tracking methods by name."""

from __future__ import annotations

from collections.abc import Callable

from flexsheet.nodes.triangulator.adaptive import AdaptiveBank
from flexsheet.nodes.triangulator.filters import Filter, OneEuro, Unfiltered

TRACKING_METHODS: dict[str, Callable[[float], Filter]] = {
    "none": Unfiltered,
    "one_euro": OneEuro,
    "adaptive": AdaptiveBank,
}
"""Filters by name, made for a finger's maximum speed (m/s)."""
