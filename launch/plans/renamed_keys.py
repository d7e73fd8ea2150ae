"""List the renamed keys and values of launch files and scenes.

Error texts use these lists to state the new names.
"""

from __future__ import annotations

from collections.abc import Mapping

NODE_PARAMETERS: Mapping[str, Mapping[str, str]] = {
    "arm_bridge": {
        "furthest_extrapolation_s": "max_extrapolation_s",
        "largest_lag_rad": "max_tracking_error_rad",
    },
    "console": {"drives_finger": "control_finger", "kept": "state_file"},
    "fem_solver": {"largest_depth_m": "max_depth_m", "lead_s": "prediction_horizon_s"},
    "planner": {
        "arrival_s": "actuation_delay_s",
        "largest_spin_rad": "max_spin_rad",
        "lead_s": "prediction_horizon_s",
        "oldest_s": "max_age_s",
        "presents": "compliance_mode",
        "release_m": "contact_off_m",
        "touch_m": "contact_on_m",
    },
    "recorder": {"also": "include", "waits": "start_paused"},
    "renderer": {
        "lead_s": "prediction_horizon_s",
        "light_s": "display_latency_s",
        "stale_s": "max_age_s",
        "still_rate_hz": "idle_rate_hz",
    },
    "triangulator": {
        "ahead_s": "prediction_horizon_s",
        "forget_after_s": "track_timeout_s",
        "mark": "marker",
        "mark_max_area_px": "marker_max_area_px",
        "mark_min_area_px": "marker_min_area_px",
        "mark_min_contrast": "marker_min_contrast",
        "mark_noise_px": "marker_noise_px",
        "mark_radius_m": "marker_radius_m",
    },
    "twin_eye": {"again_after_s": "min_interval_s", "most_waiting": "max_queue"},
}
"""The new names of renamed node parameters, by node type and former name."""

SCENE_KEYS: Mapping[str, str] = {"mark": "marker"}
"""The new names of renamed keys of scene files, by former name."""

REMOVED_KEYS = frozenset({"kinematics", "triangulation"})
"""The keys of scenes and node parameters that were removed.

They were removed because only one value was still possible.
"""

LAUNCH_KEYS: Mapping[str, str] = {
    "from_tools": "external_topics",
    "also": "include",
    "waits": "start_paused",
}
"""The new names of renamed keys of launch files, by former name.

Keys below `record` are included.
"""

VALUES: Mapping[str, Mapping[str, str]] = {
    "arming": {"by_command": "manual", "by_itself": "auto"},
    "compliance_mode": {"curve": "force_curve", "stretch": "stiffness"},
    "sheet_shape": {"dents": "reduced_order", "flat": "four_triangles"},
    "sheet_force": {"cubic": "scaled", "linear": "scaled"},
    "marker": {"weighted_centroid": "subpixel_fit"},
    "tracking": {
        "hand": "adaptive",
        "singer_tremor": "adaptive",
        "constant_velocity": "adaptive",
        "constant_acceleration": "adaptive",
        "exponential": "one_euro",
    },
    "driver": {"mxt_pose": "mxt"},
    "pattern": {"places_x": "coordinate_ramp_x", "places_y": "coordinate_ramp_y"},
}
"""The new names of renamed values, such as methods and modes, by key and former name."""
