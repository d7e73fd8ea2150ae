"""The triangulator: pictures in, fingertip out."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from messages.base import Header
from messages.calibration import StereoCalibration, load_calibration
from messages.scene import NonNegative, Positive, Scene
from messages.types import Fingertip, FingertipReason, StereoPair
from nodes.node import Input, Node, NodeParameters, Output
from nodes.triangulator.fingertip import Eyesight, locate
from nodes.triangulator.mark import MARK_METHODS, MarkLooks
from nodes.triangulator.tracking import Tracker, TrackingSettings, with_tremor
from nodes.triangulator.triangulation import TRIANGULATION_METHODS, Measured, StereoGeometry

UNKNOWN = np.diag([1.0] * 3 + [10.0] * 3)
"""Covariance (m, m/s) before the finger was ever seen."""


class TriangulatorParameters(NodeParameters):
    """How the mark is found, triangulated and tracked."""

    calibration: Path | None = Field(
        default=None, description="file of `flexsheet calibrate stereo`; null: the scene's optics"
    )
    mark: Literal["moments", "weighted_centroid"] = "weighted_centroid"
    triangulation: Literal["midpoint", "dlt", "optimal"] = "dlt"
    mark_noise_px: Positive | None = Field(
        default=None, description="of a mark's centre; null: what the method leaves in the twin"
    )
    max_reprojection_px: Positive = 1.5
    mark_min_contrast: Positive = 60.0
    mark_min_area_px: Annotated[int, Field(ge=1)] = 6
    mark_max_area_px: Annotated[int, Field(ge=1)] = 1500
    window_half_px: Annotated[int, Field(ge=8)] = 28
    acceleration_noise: Positive = Field(
        default=0.003, description="of a hand that goes evenly, m/s^2 per root hertz"
    )
    tremor_m: NonNegative = Field(
        default=5e-5, description="standard deviation of a tremor, which the track leaves out"
    )
    largest_acceleration_noise: Positive = Field(
        default=1.0, description="of a hand that starts, stops or turns"
    )
    forget_after_s: Positive = 0.1
    confirm_frames: Annotated[int, Field(ge=1)] = 3


class Triangulator(Node):
    """Measures the fingertip in each stereo pair and follows it."""

    parameters: TriangulatorParameters
    scene: Input[Scene]
    stereo: Input[StereoPair]
    fingertip: Output[Fingertip]

    calibration: StereoCalibration | None = None
    geometry: StereoGeometry | None = None
    newest: tuple[int, int] = (0, 0)
    out_of_order = 0

    async def setup(self) -> None:
        if self.parameters.calibration is not None:
            self.calibration = load_calibration(self.parameters.calibration)

    def on_scene(self, scene: Scene, header: Header) -> None:
        p = self.parameters
        method = MARK_METHODS[p.mark]
        self.geometry = None
        self.geometry = StereoGeometry.of(scene.camera, self.calibration)
        self.volume = (scene.finger.volume_min_m, scene.finger.volume_max_m)
        self.reasons: Counter[FingertipReason] = Counter()
        self.eyesight = Eyesight(
            looks=MarkLooks(
                min_contrast=p.mark_min_contrast,
                min_area_px=p.mark_min_area_px,
                max_area_px=p.mark_max_area_px,
                window_half_px=p.window_half_px,
            ),
            centroid=method.centroid,
            triangulate=TRIANGULATION_METHODS[p.triangulation],
            noise_px=p.mark_noise_px or method.noise_px,
            max_reprojection_px=p.max_reprojection_px,
        )
        self.tracking = TrackingSettings(
            acceleration_noise=p.acceleration_noise,
            largest_acceleration_noise=p.largest_acceleration_noise,
            max_speed_m_per_s=scene.finger.max_speed_m_per_s,
            forget_after_s=p.forget_after_s,
            confirm_frames=p.confirm_frames,
        )
        self.tracker = Tracker(self.tracking)

    def on_stereo(self, pair: StereoPair, header: Header) -> None:
        if self.geometry is None:
            return
        self._refuse_other_pictures(pair, self.geometry)
        if header.epoch != self.newest[0]:  # the camera was started anew, and its times with it
            self.tracker = Tracker(self.tracking)
        elif header.source_ns <= self.newest[1]:
            self.out_of_order += 1
            self._note()
            return
        self.newest = (header.epoch, header.source_ns)
        reason, measured = locate(
            pair.left,
            pair.right,
            geometry=self.geometry,
            eyesight=self.eyesight,
            volume=self.volume,
            expected=self.tracker.expected(header.source_ns),
        )
        if reason == "ok":
            assert measured is not None
            taken = self.tracker.take(header.source_ns, measured.point_world, measured.covariance)
            reason = "ok" if taken else "too_fast"
        self.reasons[reason] += 1
        self.fingertip.publish(self._message(reason, measured), source_ns=header.source_ns)
        self._note()

    def _note(self) -> None:
        counts = ", ".join(f"{count} {reason}" for reason, count in self.reasons.items())
        self.note = f"{counts}; {self.out_of_order} out of order"

    def _message(self, reason: FingertipReason, measured: Measured | None) -> Fingertip:
        track = self.tracker.track
        position = np.zeros(3) if track is None else track.position.copy()
        return Fingertip(
            valid=reason == "ok",
            reason=reason,
            position_world_m=position,
            velocity_world_m_per_s=np.zeros(3) if track is None else track.velocity.copy(),
            covariance=UNKNOWN if track is None else with_tremor(track, self.parameters.tremor_m),
            measured_world_m=position if measured is None else measured.point_world,
            reprojection_px=0.0 if measured is None else measured.reprojection_px,
        )

    def _refuse_other_pictures(self, pair: StereoPair, geometry: StereoGeometry) -> None:
        if pair.device != geometry.device:
            raise ValueError(
                f'pictures of device "{pair.device}", the scene\'s is "{geometry.device}"'
            )
        wanted = (geometry.height_px, geometry.width_px)
        for side, image in (("left", pair.left), ("right", pair.right)):
            if image.shape != wanted:
                raise ValueError(
                    f"{side} picture of {image.shape[1]}x{image.shape[0]} px, "
                    f"the scene's camera {pair.device} gives {wanted[1]}x{wanted[0]} px"
                )
