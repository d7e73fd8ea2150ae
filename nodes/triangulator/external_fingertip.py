"""Track the fingertip from positions that an external program measures."""

from __future__ import annotations

import numpy as np

from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Fingertip, FingertipReason
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.triangulator.parameters import TriangulatorParameters
from flexsheet.nodes.triangulator.tracking import Tracker, make_horizons_s


class ExternalFingertip:
    """A tracker for fingertip positions that an external program measures.

    noise_m: standard deviation of the positions per axis.
    """

    def __init__(self, scene: Scene, noise_m: float) -> None:
        limits, max_speed_m_per_s = TriangulatorParameters(), scene.finger.max_speed_m_per_s
        self._tracker = Tracker(limits.tracking_settings(max_speed_m_per_s))
        self._volume = (scene.finger.volume_min_m, scene.finger.volume_max_m)
        self._covariance = np.eye(3) * noise_m**2
        self._horizons_s = make_horizons_s(limits.prediction_horizon_s)

    def update(self, at_ns: int, measured_m: Floats) -> Fingertip:
        """Track the fingertip with a measured world position (3,), m, and return its message."""
        low, high = self._volume
        reason: FingertipReason = "outside_volume"
        if ((measured_m >= low) & (measured_m <= high)).all():
            reason = self._tracker.update(at_ns, measured_m, self._covariance)
        return self._tracker.make_fingertip(at_ns, reason, measured_m, horizons_s=self._horizons_s)
