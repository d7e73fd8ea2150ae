"""The triangulator: pictures in, fingertip out."""

from __future__ import annotations

from collections import Counter
from functools import partial

import numpy as np

from messages.base import Header
from messages.calibration import StereoCalibration, load_calibration
from messages.methods import chosen
from messages.scene import Scene
from messages.types import Fingertip, FingertipReason, StereoPair
from nodes.node import Input, Node, Output
from nodes.triangulator.company import Company
from nodes.triangulator.filters import TRACKING_METHODS
from nodes.triangulator.fingertip import Eyesight, look
from nodes.triangulator.mark import MARK_METHODS, MarkLooks
from nodes.triangulator.pairs import refuse_other_pictures
from nodes.triangulator.parameters import TriangulatorParameters
from nodes.triangulator.skew import sighting_unskewed
from nodes.triangulator.subpixel import PixelNoise
from nodes.triangulator.tracking import Tracker, TrackingSettings
from nodes.triangulator.triangulation import TRIANGULATION_METHODS, Measured, StereoGeometry

AHEAD_STEP_S = 0.01
"""Between the points of the predicted path; a swing of 10 Hz is told ten times."""


class Triangulator(Node):
    """Measures the fingertip in each stereo pair and follows it."""

    parameters: TriangulatorParameters
    scene: Input[Scene]
    stereo: Input[StereoPair]
    fingertip: Output[Fingertip]

    calibration: StereoCalibration | None = None
    geometry: StereoGeometry | None = None
    epoch, late = 0, 0

    async def setup(self) -> None:
        if path := self.parameters.calibration:
            self.calibration = load_calibration(path)

    def on_scene(self, scene: Scene, header: Header) -> None:
        p = self.parameters
        self.geometry = None
        self.geometry = StereoGeometry.of(scene.camera, self.calibration)
        self.volume = (scene.finger.volume_min_m, scene.finger.volume_max_m)
        self.reasons: Counter[FingertipReason] = Counter()
        mark = chosen(p.mark, scene.methods.mark, "subpixel_fit")
        triangulation = chosen(p.triangulation, scene.methods.triangulation, "dlt")
        tracking = chosen(p.tracking, scene.methods.tracking, "hand")
        self.methods = f"{mark}, {triangulation}, {tracking}"
        self.filter = TRACKING_METHODS[tracking](scene.finger.max_speed_m_per_s)
        self.eyesight = Eyesight(
            looks=MarkLooks(
                min_contrast=p.mark_min_contrast,
                min_area_px=p.mark_min_area_px,
                max_area_px=p.mark_max_area_px,
                window_half_px=p.window_half_px,
            ),
            refine=MARK_METHODS[mark],
            triangulate=TRIANGULATION_METHODS[triangulation],
            noise_px=p.mark_noise_px,
            mark_radius_m=p.mark_radius_m,
            max_reprojection_px=p.max_reprojection_px,
            sensor=PixelNoise(scene.camera.read_noise_levels, scene.camera.photons_per_level),
        )
        self.leads_s = np.arange(0.0, p.ahead_s + 1.5 * AHEAD_STEP_S, AHEAD_STEP_S)
        self.tracking = TrackingSettings(
            max_speed_m_per_s=scene.finger.max_speed_m_per_s,
            max_acceleration_m_per_s2=p.max_acceleration_m_per_s2,
            forget_after_s=p.forget_after_s,
            confirm_frames=p.confirm_frames,
        )
        self._begin(self.epoch)

    def on_stereo(self, pair: StereoPair, header: Header) -> None:
        if self.geometry is None:
            return
        refuse_other_pictures(pair, self.geometry)
        at_ns = header.source_ns
        if header.epoch != self.epoch:  # the camera was started anew, and its times with it
            self._begin(header.epoch)
        sight = partial(
            look,
            pair.left,
            pair.right,
            geometry=self.geometry,
            eyesight=self.eyesight,
            volume=self.volume,
            left_origin_px=pair.left_origin_px,
            right_origin_px=pair.right_origin_px,
        )
        sighting = sight(expected=self.tracker.expected(at_ns))
        if pair.skew_s != 0.0:
            motion = self.tracker.velocity_at(at_ns)
            sighting = sighting_unskewed(sighting, self.geometry, pair.skew_s, *motion)
        is_late = self.tracker.is_late(at_ns)
        reason, measured = self.company.judge(at_ns, sighting, self.tracker)
        if is_late and reason != "ok":  # what it has to tell is in the track; a later one is out
            self.late += 1
        else:
            self.reasons[reason] += 1
            self.fingertip.publish(self._message(at_ns, reason, measured), source_ns=at_ns)
        if reason == "ok" and self.company.is_survey_due(at_ns):  # nobody waits for it
            self.company.survey(at_ns, sight(expected=None))
        self._note()

    def _begin(self, epoch: int) -> None:
        self.epoch = epoch
        self.tracker = Tracker(self.filter, self.tracking)
        self.company = Company()

    def _note(self) -> None:
        counts = ", ".join(f"{count} {reason}" for reason, count in self.reasons.items())
        self.note = f"{counts}; {self.late} late; by {self.methods}"

    def _message(self, at_ns: int, reason: FingertipReason, measured: Measured | None) -> Fingertip:
        tracker = self.tracker
        track = tracker.track_at(at_ns, self.leads_s)
        return Fingertip(
            valid=reason == "ok",
            state=tracker.state(at_ns),
            reason=reason,
            position_world_m=track.position,
            velocity_world_m_per_s=track.velocity,
            covariance=track.covariance,
            ahead_world_m=track.ahead,
            ahead_step_s=AHEAD_STEP_S,
            measured_world_m=track.position if measured is None else measured.point_world,
            reprojection_px=0.0 if measured is None else measured.reprojection_px,
        )
