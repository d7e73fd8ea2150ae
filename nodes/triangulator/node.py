"""Track the fingertip in stereo image pairs."""

from __future__ import annotations

import asyncio
from collections import Counter
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import numpy as np
import scipy

from flexsheet.messages.base import Header
from flexsheet.messages.calibration import StereoCalibration
from flexsheet.messages.marker_calibration import (
    MarkerCalibration,
    refuse_other_marker,
)
from flexsheet.messages.notes import NoteCode
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import (
    Fingertip,
    FingertipReason,
    ParameterChange,
    StereoPair,
)
from flexsheet.nodes.models.finger_frame import world_from_finger
from flexsheet.nodes.models.measured_period import MeasuredPeriod
from flexsheet.nodes.node import Input, Node, Output
from flexsheet.nodes.triangulator.data_association import DataAssociation
from flexsheet.nodes.triangulator.fingertip import (
    DetectionInput,
    DetectorConfig,
    StereoDetection,
    detect_all,
)
from flexsheet.nodes.triangulator.marker import BlobFilter
from flexsheet.nodes.triangulator.parameters import TriangulatorParameters
from flexsheet.nodes.triangulator.self_checks import CameraCheck
from flexsheet.nodes.triangulator.skew import compensate_skew
from flexsheet.nodes.triangulator.subpixel import PixelNoise
from flexsheet.nodes.triangulator.tracking import Tracker, make_horizons_s
from flexsheet.nodes.triangulator.triangulation import (
    StereoGeometry,
    TriangulatedPoint,
    check_images,
)

TIMEOUT_PERIODS = 2.5
"""The minimum timeout of a track, in frame periods. A track survives one missing image pair."""


SAME_POINT_M = 0.001
"""The maximum distance between two points of an image pair that are treated as the same marker."""


@dataclass(frozen=True, slots=True)
class ProcessedPair:
    """An image pair whose fingertip is published.

    at_ns: timestamp of the exposure.
    reason: "ok", or why no fingertip was measured.
    measured: marker of the finger, or None if it was not found.
    detection: markers that were found near the expected fingertip.
    inputs: images and settings of the detection.
    """

    at_ns: int
    reason: FingertipReason
    measured: TriangulatedPoint | None
    detection: StereoDetection
    inputs: DetectionInput


class Triangulator(Node):
    """A node that detects and tracks the fingertip in stereo image pairs.

    The cameras track a marker on the finger. The fingertip is the point of the finger's pad that
    touches the sheet. The offset between marker and fingertip is assumed to be constant.
    """

    watched_inputs: ClassVar[frozenset[str]] = frozenset({"stereo"})
    ends_with_inputs: ClassVar[bool] = True
    live_parameters: ClassVar[frozenset[str]] = frozenset({"track_timeout_s"})
    parameters: TriangulatorParameters
    scene: Input[Scene]
    stereo: Input[StereoPair]
    parameter: Input[ParameterChange]
    fingertip: Output[Fingertip]

    calibration: StereoCalibration | None = None
    marker_calibration: MarkerCalibration | None = None
    geometry: StereoGeometry | None = None
    epoch, late = 0, 0

    async def setup(self) -> None:
        # SciPy imports a submodule on first use, which must not delay an image.
        _ = scipy.special
        if path := self.parameters.calibration:
            self.calibration = StereoCalibration.load(path)
        if path := self.parameters.marker_calibration:
            self.marker_calibration = MarkerCalibration.load(path)

    def on_scene(self, scene: Scene, header: Header) -> None:
        p = self.parameters
        self.geometry = None
        marker_from_pad_m = scene.finger.marker_from_pad_m
        if self.marker_calibration is not None:
            refuse_other_marker(self.marker_calibration, scene)
            marker_from_pad_m = self.marker_calibration.marker_from_pad_m
        self.geometry = StereoGeometry.of(scene.camera, self.calibration)
        turned = world_from_finger(scene.finger.direction_world)
        self.pad_to_marker_m = turned @ np.array(marker_from_pad_m)
        self.volume = (
            scene.finger.volume_min_m + self.pad_to_marker_m,
            scene.finger.volume_max_m + self.pad_to_marker_m,
        )
        self.reasons: Counter[FingertipReason] = Counter()
        self.config = DetectorConfig(
            blob_filter=BlobFilter(min_contrast=p.marker_min_contrast),
            marker_radius_m=p.marker_radius_m,
            max_reprojection_px=p.max_reprojection_px,
            sensor=PixelNoise(scene.camera.read_noise_levels, scene.camera.photons_per_level),
        )
        self.horizons_s = make_horizons_s(p.prediction_horizon_s)
        self.tracking = p.tracking_settings(scene.finger.max_speed_m_per_s)
        touch_point = p.touch_point_world_m
        self._check = CameraCheck(
            np.array(p.reference_marks_world_m, dtype=np.float64),
            None if touch_point is None else np.array(touch_point),
        )
        self._period = MeasuredPeriod(1.0 / scene.camera.rate_hz)
        self._restart(self.epoch)

    def _adapt_timeout(self, source_ns: int) -> None:
        timeout_s = max(
            self.parameters.track_timeout_s, TIMEOUT_PERIODS * self._period.add(source_ns)
        )
        if timeout_s != self.tracking.track_timeout_s:
            self.tracking = replace(self.tracking, track_timeout_s=timeout_s)
            self.tracker.settings = self.tracking

    async def on_stereo(self, pair: StereoPair, header: Header) -> None:
        processed = self.measure_fingertip(pair, header)
        if processed is not None:
            # A planner in the same process handles the fingertip before the search below.
            await asyncio.sleep(0)
            self.search_surroundings(processed)

    def measure_fingertip(self, pair: StereoPair, header: Header) -> ProcessedPair | None:
        """Measure the fingertip in an image pair, and publish it.

        Returns None if no scene has arrived. Otherwise, call `search_surroundings` with the result
        before the next pair is processed. Raises ValueError if the images are invalid.
        """
        if self.geometry is None:
            return None
        check_images(pair, self.geometry)
        at_ns = header.source_ns
        if header.epoch != self.epoch:  # The camera has restarted, so its times start again.
            self._restart(header.epoch)
        self._adapt_timeout(at_ns)
        inputs = DetectionInput(
            (pair.left, pair.right),
            self.geometry,
            self.config,
            self.volume,
            self.tracker.gate(at_ns),
            (pair.left_origin_px, pair.right_origin_px),
        )
        found = detect_all(inputs)
        detection = self._check.exclude_marks(found, tracked=inputs.gate is not None)
        if pair.skew_s != 0.0:
            velocity, covariance = self.tracker.velocity_at(at_ns)
            correct = partial(
                compensate_skew,
                geometry=self.geometry,
                skew_s=pair.skew_s,
                velocity=velocity,
                velocity_covariance=covariance,
            )
            detection = detection.correct_points(correct)
        is_late = self.tracker.is_late(at_ns)
        reason, measured = self.association.select_finger(at_ns, detection, self.tracker)
        if is_late and reason != "ok":  # a newer fingertip was published already
            self.late += 1
        else:
            self.reasons[reason] += 1
            fingertip = self.tracker.make_fingertip(
                at_ns,
                reason,
                None if measured is None else measured.point_world,
                horizons_s=self.horizons_s,
                reprojection_px=0.0 if measured is None else measured.reprojection_px,
                offset_m=self.pad_to_marker_m,
            )
            self.fingertip.publish(fingertip, source_ns=at_ns)
        return ProcessedPair(at_ns, reason, measured, found, inputs)

    def search_surroundings(self, processed: ProcessedPair) -> None:
        """Search an image pair for clutter once per search period, and update the self-checks."""
        found = processed.detection
        if processed.reason == "ok" and self.association.is_clutter_search_due(processed.at_ns):
            found = detect_all(replace(processed.inputs, gate=None))
            others = self._check.exclude_marks(found, tracked=False)
            self.association.track_clutter(processed.at_ns, others)
        self._update_self_checks(processed.at_ns, processed.reason, processed.measured, found)
        self._note()

    def _update_self_checks(
        self,
        at_ns: int,
        reason: FingertipReason,
        measured: TriangulatedPoint | None,
        detection: StereoDetection,
    ) -> None:
        if reason == "ok" and measured is not None:
            pad = measured.point_world - self.pad_to_marker_m
            self._check.on_finger(pad, measured.reprojection_px, at_ns)
        points = [one.point for one in (*detection.markers, *detection.clutter)]
        if reason == "ok" and measured is not None:
            finger = measured.point_world
            points = [one for one in points if np.linalg.norm(one - finger) > SAME_POINT_M]
        self._check.on_marks(points, at_ns)
        self.self_checks = self._check.results()

    def _restart(self, epoch: int) -> None:
        self.epoch = epoch
        self.tracker = Tracker(self.tracking)
        self.association = DataAssociation()

    def _note(self) -> None:
        counts = ", ".join(f"{count} {reason}" for reason, count in self.reasons.items())
        self.set_note(NoteCode.INFO, f"{counts}; image pairs dropped as late: {self.late}")
