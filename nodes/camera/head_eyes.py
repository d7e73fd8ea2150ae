"""Detect the user's eyes in an image, compute their positions in the world, and filter them."""

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
from flexsheet.nodes.models.camera import camera_matrix
from flexsheet.nodes.models.one_euro import OneEuro
from flexsheet.nodes.models.rigid import apply

Detector = Callable[[Image], Floats | None]
"""A function that returns the pixel positions (2, 2) of the left and right eye in a grey image.

The function returns None if the image contains no face."""

PACKAGES_MISSING = (
    "the packages dlib-bin and face-recognition-models are not installed; run: "
    "pip install 'flexsheet[head]'"
)
LANDMARKS_FILE = "shape_predictor_5_face_landmarks.dat"


def load_detector(search_width_px: int) -> Detector:
    """Load the face detector and the landmark model of the package dlib.

    search_width_px: width to which larger images are reduced for the face search. The eyes are then
        detected in the full image.

    If an image contains several faces, the largest face is used. Raises DeviceError if dlib or its
    models are not installed.
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

    pixels: positions (2, 2) of the left and the right eye in the image, px.
    interocular_m: distance between the eyes.

    Both results are in the world frame, m. Both eyes are assumed to have the same depth. If the
    head is rotated about the vertical by an angle, the computed distance is too large by a factor
    of about 1 / cos(angle).
    """
    matrix = camera_matrix(lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px)
    rays = np.ones((2, 3))
    rays[:, :2] = cv2.undistortPoints(
        pixels.reshape(2, 1, 2), matrix, np.array(lens.distortion)
    ).reshape(2, 2)
    depth_m = interocular_m / max(math.dist(*rays), 1e-9)
    eyes = apply(world_from_camera, depth_m * rays)
    return eyes.mean(axis=0), eyes[1] - eyes[0]


class EyeFilter:
    """A 1 euro filter for the positions of the eyes.

    min_cutoff_hz: cut-off frequency at rest.
    cutoff_per_speed_hz: increase of the cut-off frequency with the speed, Hz per m/s.
    """

    def __init__(self, min_cutoff_hz: float, cutoff_per_speed_hz: float) -> None:
        self._low_pass = OneEuro(min_cutoff_hz, cutoff_per_speed_hz, speed_cutoff_hz=1.0)
        self.reset()

    def reset(self) -> None:
        """Discard all earlier values, so that `update` returns the next value unchanged."""
        self._last: tuple[float, Floats, Floats] | None = None

    def update(self, at_s: float, value: Floats) -> Floats:
        """Filter a new value with n elements (n,), and return the filtered value (n,).

        at_s: time of the value, which must be later than the time of the previous value.
        """
        if self._last is None:
            self._last = at_s, value, np.zeros_like(value)
            return value
        before_s, filtered, velocity = self._last
        step_s = at_s - before_s
        filtered, velocity, _ = self._low_pass.step(
            filtered,
            velocity,
            value=value,
            measured_velocity=(value - filtered) / step_s,
            step_s=step_s,
        )
        self._last = at_s, filtered, velocity
        return filtered
