"""Track the fingertip from positions that an external program measures."""

from __future__ import annotations

import numpy as np

from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Fingertip, FingertipReason
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.triangulator.adaptive import TRACKING_METHODS
from flexsheet.nodes.triangulator.parameters import TriangulatorParameters
from flexsheet.nodes.triangulator.tracking import (
    PREDICTION_STEP_S,
    Tracker,
    TrackingSettings,
    make_horizons_s,
)


class ExternalFingertip:
    """A tracker for fingertip positions that an external program measures.

    noise_m: standard deviation of the positions per axis.
    """

    def __init__(self, scene: Scene, noise_m: float) -> None:
        limits = TriangulatorParameters()
        settings = TrackingSettings(
            max_speed_m_per_s=scene.finger.max_speed_m_per_s,
            max_acceleration_m_per_s2=limits.max_acceleration_m_per_s2,
            track_timeout_s=limits.track_timeout_s,
            confirm_frames=limits.confirm_frames,
        )
        method = TRACKING_METHODS[scene.methods.tracking or "adaptive"]
        self._tracker = Tracker(method(scene.finger.max_speed_m_per_s), settings)
        self._volume = (scene.finger.volume_min_m, scene.finger.volume_max_m)
        self._covariance = np.eye(3) * noise_m**2
        self._horizons_s = make_horizons_s(limits.prediction_horizon_s)

    def update(self, at_ns: int, measured_m: Floats) -> Fingertip:
        """Add a measured position (3,), m, in the world frame, and return the tracked fingertip."""
        low, high = self._volume
        reason: FingertipReason = "outside_volume"
        if ((measured_m >= low) & (measured_m <= high)).all():
            reason = self._tracker.update(at_ns, measured_m, self._covariance)
        return self._make(at_ns, reason, measured_m)

    def predict(self, at_ns: int) -> Fingertip:
        """Return an invalid fingertip for a time at which no position has arrived."""
        return self._make(at_ns, "no_marker", None)

    def _make(self, at_ns: int, reason: FingertipReason, measured_m: Floats | None) -> Fingertip:
        track = self._tracker.predict_at(at_ns, self._horizons_s)
        return Fingertip(
            valid=reason == "ok",
            state=self._tracker.state(at_ns),
            reason=reason,
            position_world_m=track.position,
            velocity_world_m_per_s=track.velocity,
            covariance=track.covariance,
            predicted_path_world_m=track.path,
            prediction_step_s=PREDICTION_STEP_S,
            measured_world_m=track.position if measured_m is None else measured_m,
            reprojection_px=0.0,
        )
