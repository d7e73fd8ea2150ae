"""Check the stereo camera and the marker by residuals of triangulated points.

Three residuals are independent of each other.  The reprojection error shows a motion of one camera
against the other.  Fixed reference marks show a motion of the whole stereo camera.  A finger that
rests at a known point shows an offset of its marker, after the shift of the reference marks has
been subtracted.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.types import SelfCheck, SuspectedCause
from flexsheet.nodes.models.residuals import ResidualMonitor
from flexsheet.nodes.triangulator.fingertip import StereoDetection

Floats = NDArray[np.float64]

REPROJECTION_THRESHOLD_PX = 0.2
"""Mean reprojection error.  A calibration leaves 0.024 px, uncalibrated drift of the right camera
(0.2 mrad) some 0.1 px; 1 mm of vertical shift at half a metre causes 0.5 px."""

MARK_THRESHOLD_M = 6e-4
"""Shift of the reference marks.  After a calibration (docs/apparatus.md) it has 0.12 mm of standard
deviation per axis, so that five are allowed."""

MARKER_THRESHOLD_M = 1.5e-3
"""Distance of a resting finger from the known point: 0.3 mm of calibrated marker offset per axis,
0.12 mm of the camera and 0.1 mm of noise; more than four standard deviations per axis."""

MARK_RADIUS_M = 0.008
TOUCH_RADIUS_M = 0.012
"""Distances within which a point is the reference mark, and a finger is at the known point."""

STILL_S = 0.7
STILL_M = 2.5e-4
"""Time and standard deviation of a finger at rest.  A finger that hovers moves more."""


class CameraCheck:
    """Self-checks of the stereo camera and of the marker.

    reference_marks: world positions (n, 3) m of fixed marks that look like the finger's marker.
    touch_point: world position (3,) m of the fingertip when it rests at the known point, or None.
    """

    def __init__(self, reference_marks: Floats, touch_point: Floats | None) -> None:
        self._marks, self._touch_point = reference_marks.reshape(-1, 3), touch_point
        self._reprojection = ResidualMonitor(1, threshold=REPROJECTION_THRESHOLD_PX)
        self._camera = ResidualMonitor(3, threshold=MARK_THRESHOLD_M)
        self._marker = ResidualMonitor(3, threshold=MARKER_THRESHOLD_M, memory_s=1.0, confirm_s=0.5)
        self._resting: deque[tuple[int, Floats]] = deque()

    def on_marks(self, points: Sequence[Floats], at_ns: int) -> None:
        """Add the positions (3,) of all marks beside the finger's in an image pair."""
        if not len(self._marks) or not points:
            return
        found = np.stack(points)
        offsets = found[None, :, :] - self._marks[:, None, :]
        distances = np.linalg.norm(offsets, axis=2)
        nearest = distances.argmin(axis=1)
        rows = np.arange(len(self._marks))
        seen = distances[rows, nearest] <= MARK_RADIUS_M
        if seen.any():
            # A moved camera shifts all marks; a median ignores one mark that has moved alone.
            self._camera.add(np.median(offsets[rows, nearest][seen], axis=0), at_ns)

    def exclude_marks(self, detection: StereoDetection, *, tracked: bool) -> StereoDetection:
        """Return a detection without the reference marks, which must not compete with the finger.

        tracked: whether the search had a gate; a marker in the gate is then the finger's.
        """
        if not len(self._marks):
            return detection
        markers = detection.markers
        if not tracked:
            markers = tuple(one for one in markers if not self._is_mark(one.point))
        clutter = tuple(one for one in detection.clutter if not self._is_mark(one.point))
        return replace(detection, markers=markers, clutter=clutter)

    def _is_mark(self, point: Floats) -> bool:
        return bool((np.linalg.norm(self._marks - point, axis=1) <= MARK_RADIUS_M).any())

    def on_finger(self, point: Floats, reprojection_px: float, at_ns: int) -> None:
        """Add a triangulated fingertip (3,) with its reprojection error."""
        self._reprojection.add(np.array([reprojection_px]), at_ns)
        if self._touch_point is None:
            return
        offset = point - self._touch_point
        if not float(np.linalg.norm(offset)) <= TOUCH_RADIUS_M:
            self._resting.clear()
            return
        self._resting.append((at_ns, offset))
        while at_ns - self._resting[0][0] > 1e9 * STILL_S:
            self._resting.popleft()
        span_s = (at_ns - self._resting[0][0]) * 1e-9
        offsets = np.stack([one for _, one in self._resting])
        if span_s < 0.8 * STILL_S or float(offsets.std(axis=0).max()) > STILL_M:
            return
        shift = self._camera.mean if self._camera.has_data else np.zeros(3)
        self._marker.add(offset - shift, at_ns)

    def results(self) -> tuple[SelfCheck, ...]:
        """Return the checks that have data."""
        found = []
        if self._reprojection.has_data:
            found.append(
                SelfCheck(
                    cause="cameras_misaligned",
                    unit="px",
                    value=self._reprojection.deviation,
                    expected=0.0,
                    threshold=REPROJECTION_THRESHOLD_PX,
                    suspected=self._reprojection.suspected,
                )
            )
        if self._camera.has_data:
            found.append(_distance_check("camera_moved", self._camera))
        if self._marker.has_data:
            found.append(_distance_check("marker_offset", self._marker))
        return tuple(found)


def _distance_check(cause: SuspectedCause, monitor: ResidualMonitor) -> SelfCheck:
    return SelfCheck(
        cause=cause,
        unit="m",
        value=monitor.deviation,
        expected=0.0,
        threshold=monitor.threshold,
        suspected=monitor.suspected,
    )
