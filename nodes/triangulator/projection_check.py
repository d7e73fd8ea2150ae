"""Compare the positions of projected marks on the sheet with their expected positions.

Wherever the sheet is, a projected mark is on the ray of its projector pixel. The distance of a mark
from this ray therefore indicates errors of the projector and the camera. The distance of a mark
from the expected surface of the sheet indicates errors of the arms and the camera. Near a finger
that pushes the sheet, the sheet moves by a known fraction of the finger's motion. Marks near the
finger therefore indicate errors of the finger's depth.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from flexsheet.messages.scene import Projector
from flexsheet.messages.types import Frame, SelfCheck, SuspectedCause
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.residuals import ResidualMonitor

RAY_THRESHOLD_M = 7e-4
"""The maximum root mean square distance of the marks from their rays. The standard deviation per
axis is 0.12 mm for a calibrated camera, and 0.03 mm for a calibrated projector."""

SURFACE_THRESHOLD_M = 1.2e-3
"""The maximum mean distance of the marks from the sheet's surface: about five standard deviations.
The camera contributes 0.12 mm. Each arm contributes 0.2 mm by its base and clamp, and 0.2 mm by the
zero positions of its joints (docs/apparatus.md)."""

FINGER_THRESHOLD_M = 2e-3
"""The maximum error of the finger's depth in the sheet. The standard deviations of its causes are
0.3 mm (marker's offset), 0.12 mm (camera), 0.25 mm (arms) and 0.2 mm (noise)."""

LATENCY_THRESHOLD_S = 0.01
"""The maximum deviation of the display latency from its configured value: ten standard deviations
of a measurement by photodiode (1 ms)."""

LATENCY_MEMORY_S = 4.0
"""The time constant for averaging the latency. It is long because the latency can be measured only
in the few camera images that still show the previous frame."""

MATCH_RADIUS_M = 0.012
"""The maximum distance between a detected point and the expected position of its mark."""

MAX_SPREAD_M = 0.004
"""The maximum difference between the offset of a mark from its expected position and the median
offset of all marks."""

MAX_AGE_NS = 300_000_000
"""The maximum age of the newest displayed frame at the exposure of an image pair."""

STILL_M_PER_S, MOVING_M_PER_S = 0.005, 0.015
"""The speed of the marks below which their positions are checked, and the speed above which the
latency is checked."""

MAX_DRIFT_M = 3e-4
"""The maximum motion of a mark along the sheet's normal between the display of a frame and the
exposure of an image. If any mark moves more, no height above the sheet is checked."""

MAX_GAIN = 4.0
"""The maximum standard deviation of the finger's estimated depth, as a multiple of the standard
deviation of a mark's height. If the multiple is larger, the marks are too far from the finger, and
the depth is not estimated."""


class ProjectionCheck:
    """The self-checks that use projected marks to test the projector, the arms and the marker.

    projector: projector of the scene; None if there is no projector.
    """

    def __init__(self, projector: Projector | None) -> None:
        marks = () if projector is None else projector.check_marks_sheet_m
        self._projector_m = (
            np.zeros(3)
            if projector is None
            else np.array(projector.world_from_projector.position_m)
        )
        self._count = len(marks)
        self._frames: deque[tuple[int, Floats, Floats, Floats]] = deque(maxlen=8)
        # Each mark is a part of this residual: errors of rotation and lens cancel in their mean.
        self._ray = ResidualMonitor(3 * len(marks), threshold=RAY_THRESHOLD_M)
        self._surface = ResidualMonitor(1, threshold=SURFACE_THRESHOLD_M)
        self._finger = ResidualMonitor(1, threshold=FINGER_THRESHOLD_M)
        self._latency = ResidualMonitor(1, threshold=LATENCY_THRESHOLD_S, memory_s=LATENCY_MEMORY_S)

    def on_frame(self, frame: Frame) -> None:
        """Store the expected positions of the check marks from the message of a displayed frame."""
        if frame.light_ns and self._count and len(frame.marks_world_m) == self._count:
            normal = frame.world_from_sheet[:3, 2]
            expected = (frame.light_ns, frame.marks_world_m, frame.marks_finger_ratio, normal)
            self._frames.append(expected)

    @property
    def expected_world_m(self) -> Floats:
        """Return the newest expected world positions (n, 3), m, of the projected check marks."""
        return self._frames[-1][1] if self._frames else np.zeros((0, 3))

    def on_points(self, points: Sequence[Floats], camera_shift_m: Floats, at_ns: int) -> None:
        """Compare bright points (3,), m, with the expected positions of the projected check marks.

        camera_shift_m: measured displacement (3,) of the fixed reference marks, caused by an error
            of the camera's pose. It is subtracted from the displacement of the check marks.
        at_ns: time of the image pair that shows the points.
        """
        shown = [number for number, frame in enumerate(self._frames) if frame[0] <= at_ns]
        if not shown or len(points) < 2:
            return
        light_ns, expected, ratios, normal = self._frames[shown[-1]]
        if at_ns - light_ns > MAX_AGE_NS:
            return
        offsets = np.stack(points)[None] - expected[:, None]
        distances = np.where(np.isfinite(offsets).all(axis=2), np.linalg.norm(offsets, axis=2), 1.0)
        nearest = distances.argmin(axis=1)
        rows = np.arange(self._count)
        is_own = distances[:, nearest].argmin(axis=0) == rows  # a point belongs to one mark only
        found = is_own & (distances[rows, nearest] <= MATCH_RADIUS_M)
        if found.sum() < 2:
            return
        offset = offsets[rows, nearest] - camera_shift_m
        rays = expected - self._projector_m
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        aside = offset - (offset * rays).sum(axis=1)[:, None] * rays
        found &= np.linalg.norm(aside - np.median(aside[found], axis=0), axis=1) <= MAX_SPREAD_M
        velocities = self._velocities(shown[-1])
        if velocities is None or found.sum() < 2:
            return
        drifts_m = np.abs(velocities @ normal) * (at_ns - light_ns) * 1e-9
        velocity = np.nanmean(velocities, axis=0)
        ray = np.nanmean(rays, axis=0)
        ray /= np.linalg.norm(ray)
        velocity = velocity - (velocity @ ray) * ray
        speed = float(np.linalg.norm(velocity))
        if speed <= STILL_M_PER_S:
            scale = 1.0 / np.sqrt(self._count)
            last = self._ray.mean.reshape(-1, 3)
            self._ray.add(np.where(found[:, None], scale * aside, last).ravel(), at_ns)
            if np.nanmax(drifts_m) <= MAX_DRIFT_M:
                self._add_surface((offset @ normal)[found], ratios[found], at_ns)
        elif speed >= MOVING_M_PER_S:
            # A frame that appears later than expected shows each mark where it was before.
            constant = np.sqrt(self._count) * self._ray.mean.reshape(-1, 3)
            late = -(aside - constant)[found].mean(axis=0) @ velocity / speed**2
            self._latency.add(np.array([late]), at_ns)

    def _velocities(self, number: int) -> Floats | None:
        """Return the velocities (n, 3), m/s, of the n marks in a frame.

        number: index of the frame in `_frames`.

        The velocity is NaN if a mark is not on the sheet. Returns None if no velocity is known.
        """
        if number == 0:
            return None
        (before_ns, before, *_), (now_ns, now, *_) = self._frames[number - 1], self._frames[number]
        step_s = (now_ns - before_ns) * 1e-9
        on_sheet = np.asarray(np.isfinite(now - before).all(axis=1))
        if step_s <= 0.0 or not on_sheet.any():
            return None
        return np.asarray(np.where(on_sheet[:, None], (now - before) / step_s, np.nan))

    def _add_surface(self, heights_m: Floats, ratios: Floats, at_ns: int) -> None:
        """Check the heights (n,), m, of projected marks above the expected surface of the sheet.

        ratios: displacements (n,) of the sheet at the marks as fractions of the finger's
            displacement; 0 for marks that the finger does not move.

        The heights consist of an error of the sheet's height, and of an error of the finger's depth
        times these ratios. Both errors are estimated and added to their residual monitors.
        """
        if not ratios.any():
            self._surface.add(np.array([heights_m.mean()]), at_ns)
            return
        spread = float(((ratios - ratios.mean()) ** 2).sum())
        if len(ratios) < 3 or spread < 1.0 / MAX_GAIN**2:
            return
        # heights = height of the sheet + ratio * height of the true finger pad
        design = np.column_stack([np.ones(len(ratios)), ratios])
        (height_m, finger_m), *_ = np.linalg.lstsq(design, heights_m, rcond=None)
        self._surface.add(np.array([height_m]), at_ns)
        self._finger.add(np.array([finger_m]), at_ns)

    def results(self, *, camera_checked: bool) -> dict[SuspectedCause, SelfCheck]:
        """Return the results of all checks that have enough data, by suspected cause.

        camera_checked: whether reference marks measure the shift of the camera.
        """
        ray, surface = self._ray, self._surface
        found: dict[SuspectedCause, SelfCheck] = {}
        # One cause is more likely than two: only the camera affects both residuals.
        is_camera = ray.suspected and surface.suspected and not camera_checked
        if ray.has_data:
            cause: SuspectedCause = (
                "projector_moved" if camera_checked else "camera_or_projector_moved"
            )
            found[cause] = make_check(cause, ray, suspected=ray.suspected and not is_camera)
        if surface.has_data:
            cause = "arm_base_moved" if camera_checked else "camera_or_arm_base_moved"
            found[cause] = make_check(cause, surface, suspected=surface.suspected and not is_camera)
        if is_camera:
            found["camera_moved"] = make_check("camera_moved", ray, suspected=True)
        if self._finger.has_data:
            found["marker_offset"] = make_check("marker_offset", self._finger)
        if self._latency.has_data:
            found["display_latency"] = make_check("display_latency", self._latency)
        return found


def make_check(
    cause: SuspectedCause, monitor: ResidualMonitor, *, suspected: bool | None = None
) -> SelfCheck:
    """Return the result of a self-check as a message part.

    cause: error that the self-check can detect.
    monitor: statistics of the residual from which the error is detected.
    suspected: whether the error is suspected; None if the monitor decides.
    """
    is_latency = cause == "display_latency"
    return SelfCheck(
        cause=cause,
        unit="s" if is_latency else "px" if cause == "cameras_misaligned" else "m",
        value=float(monitor.mean[0]) if is_latency else monitor.deviation,
        expected=0.0,
        threshold=monitor.threshold,
        suspected=monitor.suspected if suspected is None else suspected,
    )
