"""List keys and values of launch files and scenes that have new names, for the remedy in errors."""

from __future__ import annotations

from collections.abc import Mapping

NODE_PARAMETERS: Mapping[str, Mapping[str, str]] = {
    "fem_solver": {
        "largest_depth_m": "max_depth_m",
        "lead_s": "prediction_horizon_s",
    },
    "renderer": {
        "lead_s": "prediction_horizon_s",
        "light_s": "display_latency_s",
        "stale_s": "max_age_s",
        "still_rate_hz": "idle_rate_hz",
    },
}
"""Old to new parameter names, by node type."""

SCENE_KEYS: Mapping[str, str] = {}
"""Old to new keys of scene files."""

LAUNCH_KEYS: Mapping[str, str] = {}
"""Old to new keys of launch files."""

VALUES: Mapping[str, Mapping[str, str]] = {
    "sheet_shape": {"dents": "reduced_order", "flat": "four_triangles"},
    "pattern": {"places_x": "coordinate_ramp_x", "places_y": "coordinate_ramp_y"},
}
"""Old to new values, by the key that holds them: names of methods and patterns."""
