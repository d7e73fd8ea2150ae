"""Detect the user's eyes in an image, locate them in the world, and filter their motion."""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np

from flexsheet.messages.scene import Lens
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.camera.image_pair import DeviceError, Image
from flexsheet.nodes.models.rigid import apply

Detector = Callable[[Image], Floats | None]
"""Function that returns the pixels (2, 2) of the user's left and right eye in a grey image.

It returns None if the image contains no face.
"""

PACKAGES_MISSING = (
    "the packages dlib-bin and face-recognition-models are not installed; run: "
    "pip install 'flexsheet[head]'"
)
LANDMARKS_FILE = "shape_predictor_5_face_landmarks.dat"


def load_detector(search_width_px: int) -> Detector:
    """Load the face detector and the landmark model of dlib; raises DeviceError without them.

    search_width_px: maximum width of the image in which faces are searched. The landmarks are then
    located in the full image. If there are several faces, the largest one is used.
    """
    # The module with the models is only located, because its import needs setuptools.
    models = find_spec("face_recognition_models")
    if find_spec("dlib") is None or models is None or models.origin is None:
        raise DeviceError(PACKAGES_MISSING)
    import dlib

    detect_faces = dlib.get_frontal_face_detector()
    file = Path(models.origin).parent / "models" / LANDMARKS_FILE
    fit_landmarks = dlib.shape_predictor(str(file))

    def detect(image: Image) -> Floats | None:
        scale = min(1.0, search_width_px / image.shape[1])
        small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        faces = detect_faces(small, 0)
        if not faces:
            return None
        face = max(faces, key=lambda one: one.area())
        edges = (face.left(), face.top(), face.right(), face.bottom())
        parts = fit_landmarks(image, dlib.rectangle(*(round(one / scale) for one in edges))).parts()
        # Corners: two of the left eye, then two of the right eye.
        corners = np.array([(one.x, one.y) for one in parts[:4]], dtype=np.float64)
        centres: Floats = corners.reshape(2, 2, 2).mean(axis=1)
        return centres

    return detect


def locate_eyes(
    pixels: Floats, lens: Lens, interocular_m: float, world_from_camera: Floats
) -> tuple[Floats, Floats]:
    """Return the midpoint (3,) of the eyes and the vector (3,) from the left to the right eye.

    Both are in the world frame, m. pixels: left and right eye (2, 2), px. interocular_m: distance
    of the eyes; both are assumed to have the same depth. A head near the optical axis that is
    rotated by an angle about the vertical is located too far away, by a factor of 1 / cos(angle).
    """
    matrix = np.array(
        [[lens.fx_px, 0.0, lens.cx_px], [0.0, lens.fy_px, lens.cy_px], [0.0, 0.0, 1.0]]
    )
    rays = np.ones((2, 3))
    rays[:, :2] = cv2.undistortPoints(
        pixels.reshape(2, 1, 2), matrix, np.array(lens.distortion)
    ).reshape(2, 2)
    depth_m = interocular_m / max(math.dist(*rays), 1e-9)
    eyes = apply(world_from_camera, depth_m * rays)
    return eyes.mean(axis=0), eyes[1] - eyes[0]


class OneEuroFilter:
    """Low-pass filter of a vector whose cutoff frequency increases with the speed.

    Source: Casiez, Roussel and Vogel, "1 € Filter", CHI 2012.
    min_cutoff_hz: cutoff frequency at rest. cutoff_per_speed_hz: increase of the cutoff frequency
    per unit of speed.
    """

    SPEED_CUTOFF_HZ = 1.0

    def __init__(self, min_cutoff_hz: float, cutoff_per_speed_hz: float) -> None:
        self._min_hz, self._per_speed_hz = min_cutoff_hz, cutoff_per_speed_hz
        self.reset()

    def reset(self) -> None:
        """Forget the past, so that the next value is returned unchanged."""
        self._last: tuple[float, Floats, Floats] | None = None

    def update(self, at_s: float, value: Floats) -> Floats:
        """Return the filtered value; times must increase."""
        if self._last is None:
            self._last = at_s, value, np.zeros_like(value)
            return value
        before_s, filtered, speed = self._last
        step_s = at_s - before_s
        weight = _compute_weight(self.SPEED_CUTOFF_HZ, step_s)
        speed = speed + weight * ((value - filtered) / step_s - speed)
        cutoff_hz = self._min_hz + self._per_speed_hz * float(np.linalg.norm(speed))
        filtered = filtered + _compute_weight(cutoff_hz, step_s) * (value - filtered)
        self._last = at_s, filtered, speed
        return filtered


def _compute_weight(cutoff_hz: float, step_s: float) -> float:
    """Return the weight of a new value in a low-pass filter of the first order."""
    ratio = 2.0 * math.pi * cutoff_hz * step_s
    return ratio / (1.0 + ratio)
