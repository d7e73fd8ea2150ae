"""Run a triangulator on images of the simulated camera, frame by frame, for benchmarks."""

from __future__ import annotations

import bisect
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.base import Header, Message
from flexsheet.messages.calibration import StereoCalibration
from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.scene import Scene
from flexsheet.messages.topics import Topic
from flexsheet.messages.types import FingerPath, Fingertip, StereoPair
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import rotation_from_rpy
from flexsheet.nodes.triangulator.node import Triangulator
from flexsheet.nodes.triangulator.parameters import TriangulatorParameters
from flexsheet.nodes.twin.clutter import Clutter
from flexsheet.nodes.twin.finger import FingerMotion
from flexsheet.nodes.twin.pixels import Sensor, TwinCamera
from flexsheet.nodes.twin.rig import make_true_camera

TruePathCase = Callable[[float], Floats]
"""The function that returns the true fingertip (3,) at a time, s."""

ROOT = Path(__file__).resolve().parent.parent
SCENE_FILE = ROOT / "launch" / "scenes" / "cylinder.yaml"
CALIBRATION_FILE = ROOT / "launch" / "calibrations" / "twin-bumblebee.yaml"

WRONG_MARKER_M = 5e-3
"""The error of a valid fingertip above which it belongs to another object, in metres."""


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame to simulate.

    time_s: true middle of the exposure.
    stamp_s: time stamp of the camera; None if the stamp is correct.
    marker: whether the marker is visible.
    right_from_column: first column that the right camera reads.
    """

    time_s: float
    camera: TwinCamera
    stamp_s: float | None = None
    marker: bool = True
    right_from_column: int = 0

    @property
    def stamp_ns(self) -> int:
        return round(1e9 * (self.time_s if self.stamp_s is None else self.stamp_s))


@dataclass(frozen=True, slots=True)
class ObservedFrame:
    """The true fingertip (3,), m, of a frame, and the triangulator's message.

    The message is None if the frame is late.
    """

    frame: Frame
    truth: Floats
    fingertip: Fingertip | None

    @property
    def valid(self) -> bool:
        return self.fingertip is not None and self.fingertip.valid

    @property
    def reason(self) -> str:
        return "late" if self.fingertip is None else self.fingertip.reason

    @property
    def error_m(self) -> Floats:
        assert self.fingertip is not None
        return self.fingertip.position_world_m - self.truth

    @property
    def covariance(self) -> Floats:
        """Return the published covariance (3, 3) m^2 of the position."""
        assert self.fingertip is not None
        return self.fingertip.covariance[:3, :3]


@dataclass
class Observer:
    """A triangulator that receives simulated images.

    calibration: calibration file; None: exact optics of the scene.
    """

    scene: Scene
    calibration: Path | None = CALIBRATION_FILE
    parameters: dict[str, Any] = field(default_factory=dict)
    node: Triangulator = field(init=False)
    _said: list[Fingertip] = field(init=False, default_factory=list)

    async def start(self) -> Observer:
        self.node = Triangulator(
            TriangulatorParameters(calibration=self.calibration, **self.parameters),
            name="triangulator",
            clock=VirtualClock(),
            send=self._keep,
        )
        await self.node.setup()
        await self.node.step("scene", self.scene, Header(1, 0, 0, "virtual", "bench", 1))
        return self

    async def show(self, frame: Frame, motion: TruePathCase) -> ObservedFrame:
        """Simulate a frame, and pass the images to the node."""
        exposure_s = self.scene.camera.exposure_s
        left, right = frame.camera.picture(
            lambda offset_s: motion(frame.time_s + offset_s),
            exposure_s=exposure_s,
            marker=frame.marker,
            time_s=frame.time_s,
        )
        column = frame.right_from_column
        pair = StereoPair(
            device=self.scene.camera.device,
            exposure_s=exposure_s,
            dropped_frames=0,
            left=left,
            right=np.ascontiguousarray(right[:, column:]),
            right_origin_px=(column, 0),
        )
        return ObservedFrame(
            frame, motion(frame.time_s), await self.process_pair(pair, frame.stamp_ns)
        )

    async def process_pair(self, pair: StereoPair, stamp_ns: int) -> Fingertip | None:
        """Pass an image pair to the node, and return the message of the node, or None if late.

        Raises RuntimeError if a handler of the node fails.
        """
        self._said.clear()
        await self.node.step("stereo", pair, Header(1, stamp_ns, stamp_ns, "virtual", "camera", 1))
        if self.node.errors:
            raise RuntimeError(f"triangulator: {self.node.last_error}")
        return self._said[0] if self._said else None

    async def follow(self, frames: Iterable[Frame], motion: TruePathCase) -> list[ObservedFrame]:
        return [await self.show(frame, motion) for frame in frames]

    def _keep(self, topic: Topic, message: Message, header: Header) -> None:
        if isinstance(message, Fingertip):
            self._said.append(message)


def bench_scene() -> Scene:
    return load_scene(SCENE_FILE)


def twin_camera(
    scene: Scene, clutter: Clutter, *, seed: int = 1, sensor: Sensor | None = None
) -> TwinCamera:
    """Make the camera of the true rig."""
    return TwinCamera(
        make_true_camera(scene.camera),
        finger_radius_m=scene.finger.radius_m,
        seed=seed,
        clutter=clutter,
        sensor=sensor,
    )


def calibration_covariance(scene: Scene, file: Path = CALIBRATION_FILE) -> Floats:
    """Return the covariance (3, 3) of fingertips that the calibration's uncertainty causes, m^2."""
    uncertainty = StereoCalibration.load(file).uncertainty
    if uncertainty is None:
        raise ValueError(f"{file}: uncertainty: null; calibrate again to estimate it")
    across = 0.5 * uncertainty.lateral_std_m**2
    world_from_left = rotation_from_rpy(scene.camera.world_from_left.rpy_rad)
    in_left = np.diag([across, across, uncertainty.depth_std_m**2])
    return world_from_left @ in_left @ world_from_left.T


def path_motion(path: FingerPath, scene: Scene, *, seed: int) -> TruePathCase:
    """Make a finger with tremor on a path, with times from the path's start."""
    motion = FingerMotion.resting(path.positions_world_m[0], seed=seed).followed_by(
        0.0,
        times_s=path.times_s,
        points=path.positions_world_m,
        wander_m=path.wander_m,
        tremor_m=path.tremor_m,
        max_speed_m_per_s=scene.finger.max_speed_m_per_s,
        joined_by=path.joined_by,
    )
    return lambda time_s: motion.at(motion.ease_s + time_s).position


def paths_motion(
    paths: Sequence[FingerPath], scene: Scene, *, seed: int
) -> tuple[TruePathCase, float]:
    """Return the motion of a finger along several paths, and the total duration (s)."""
    motion = FingerMotion.resting(paths[0].positions_world_m[0], seed=seed)
    starts_s, motions = [0.0], [motion]
    for path in paths:
        latest = motions[-1]
        length_s = 0.0 if len(motions) == 1 else latest.ease_s + latest.path.duration_s
        starts_s.append(starts_s[-1] + length_s)
        motions.append(
            latest.followed_by(
                length_s,
                times_s=path.times_s,
                points=path.positions_world_m,
                wander_m=path.wander_m,
                tremor_m=path.tremor_m,
                max_speed_m_per_s=scene.finger.max_speed_m_per_s,
                joined_by=path.joined_by,
            )
        )
    end_s = starts_s[-1] + motions[-1].ease_s + motions[-1].path.duration_s

    def at(time_s: float) -> Floats:
        latest = max(bisect.bisect_right(starts_s, time_s) - 1, 0)
        return motions[latest].at(time_s - starts_s[latest]).position

    return at, end_s


def sigmas(seen: ObservedFrame, added: Floats) -> float:
    """Return the Mahalanobis distance of a fingertip from the truth, in standard deviations.

    added: (3, 3) m^2 of errors that the track's covariance excludes, those of the calibration.
    """
    error = seen.error_m
    return float(np.sqrt(error @ np.linalg.solve(seen.covariance + added, error)))
