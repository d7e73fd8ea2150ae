"""Check the stereo camera and the marker by residuals of triangulated points.

The reprojection error increases if one camera has moved relative to the other camera. The positions
of fixed reference marks change if the stereo camera has moved. The position of a finger at a known
point changes if the marker has moved on the finger.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flexsheet.messages.types import SelfCheck, SuspectedCause
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.residuals import ResidualMonitor
from flexsheet.nodes.triangulator.fingertip import StereoDetection

REPROJECTION_THRESHOLD_PX = 0.2
"""The maximum mean reprojection error. After a calibration, the error is 0.024 px. A drift of one
camera by 0.2 mrad causes 0.1 px, and a vertical shift by 1 mm causes 0.5 px at half a metre."""

MARK_THRESHOLD_M = 6e-4
"""The maximum shift of the reference marks: five standard deviations after a calibration
(docs/apparatus.md)."""

MARKER_THRESHOLD_M = 1.5e-3
"""The maximum distance of a resting finger from the known point: more than four standard
deviations. The standard deviations per axis of the causes are 0.3 mm (marker's offset), 0.12 mm
(camera) and 0.1 mm (noise)."""

MARK_RADIUS_M = 0.008
"""The maximum distance between a detected point and its reference mark."""

TOUCH_RADIUS_M = 0.012
"""The distance of a finger from the known point below which the finger touches the point."""

STILL_S = 0.7
"""The time for which a finger must be at rest before its position is checked."""

STILL_M = 2.5e-4
"""The maximum standard deviation of a resting finger's position. A hovering finger moves more."""


class CameraCheck:
    """The self-checks of the stereo camera and of the marker.

    reference_marks: world positions (n, 3), m, of fixed marks that look like the finger's marker.
    touch_point: world position (3,), m, of a known point that the finger can touch; None if no
        point is known.
    """

    def __init__(self, reference_marks: Floats, touch_point: Floats | None) -> None:
        self._marks, self._touch_point = reference_marks.reshape(-1, 3), touch_point
        self._reprojection = ResidualMonitor(1, threshold=REPROJECTION_THRESHOLD_PX)
        self._camera = ResidualMonitor(3, threshold=MARK_THRESHOLD_M)
        self._marker = ResidualMonitor(3, threshold=MARKER_THRESHOLD_M, memory_s=1.0, confirm_s=0.5)
        self._resting: deque[tuple[int, Floats]] = deque()

    def on_marks(self, points: Sequence[Floats], at_ns: int) -> None:
        """Check the positions of the fixed marks.

        points: world positions (3,), m, of all bright points in an image pair.
        at_ns: time of the image pair.
        """
        if not len(self._marks) or not points:
            return
        found = np.stack(points)
        offsets = found[None, :, :] - self._marks[:, None, :]
        distances = np.linalg.norm(offsets, axis=2)
        nearest = distances.argmin(axis=1)
        rows = np.arange(len(self._marks))
        seen = distances[rows, nearest] <= MARK_RADIUS_M
        if seen.any():
            # A moved camera shifts all marks.  The median ignores a single mark that has moved.
            self._camera.add(np.median(offsets[rows, nearest][seen], axis=0), at_ns)

    def exclude_marks(self, detection: StereoDetection, *, tracked: bool) -> StereoDetection:
        """Remove the fixed marks from a detection.

        These marks look like the finger's marker, but are not clutter.

        tracked: whether the position of the finger was predicted. In this case, markers near the
            prediction are not removed.
        """
        if not len(self._marks):
            return detection

        def is_mark(point: Floats) -> bool:
            return bool((np.linalg.norm(self._marks - point, axis=1) <= MARK_RADIUS_M).any())

        markers = detection.markers
        if not tracked:
            markers = tuple(one for one in markers if not is_mark(one.point))
        clutter = tuple(one for one in detection.clutter if not is_mark(one.point))
        return replace(detection, markers=markers, clutter=clutter)

    def on_finger(self, point: Floats, reprojection_px: float, at_ns: int) -> None:
        """Add a position of the finger pad, and check it if the finger rests at the known point.

        point: world position (3,), m.
        reprojection_px: reprojection error of the finger's marker.
        """
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
        camera_shift_m = self._camera.mean if self._camera.has_data else np.zeros(3)
        self._marker.add(offset - camera_shift_m, at_ns)

    def results(self) -> tuple[SelfCheck, ...]:
        """Return the results of all checks that have enough data."""
        checks: tuple[tuple[SuspectedCause, ResidualMonitor], ...] = (
            ("cameras_misaligned", self._reprojection),
            ("camera_moved", self._camera),
            ("marker_offset", self._marker),
        )
        return tuple(
            SelfCheck(
                cause=cause,
                unit="px" if monitor is self._reprojection else "m",
                value=monitor.deviation,
                expected=0.0,
                threshold=monitor.threshold,
                suspected=monitor.suspected,
            )
            for cause, monitor in checks
            if monitor.has_data
        )
