"""Method families that one node offers and another judges: only here may both be known."""

from __future__ import annotations

from nodes.renderer.families import correction_family
from nodes.twin.eye import seen_at

CORRECTION = correction_family(seen_at)
