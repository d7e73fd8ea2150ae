"""Set a camera's exposure, gain, white balance, focus and region to fixed values.

Each setting is read back. If the device does not accept a setting, a warning states the requested
value and the actual value. Units differ between OpenCV's backends (see its source files
modules/videoio/src/cap_v4l.cpp, cap_ximea.cpp and cap_aravis.cpp).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2

from flexsheet.messages.scene import StereoCamera
from flexsheet.nodes.camera.image_pair import Region

EXPOSURE_TOLERANCE = 0.05
RATE_TOLERANCE = 0.02
MAX_RATE_HZ = 10_000.0


class Device(Protocol):
    """The part of the interface of cv2.VideoCapture that is used to configure a camera."""

    def get(self, property_id: int, /) -> float: ...

    def set(self, property_id: int, value: float, /) -> bool: ...


@dataclass(frozen=True, slots=True)
class Backend:
    """The properties and units of a camera's controls in one of OpenCV's backends.

    exposure_unit_s, whole_units: unit of CAP_PROP_EXPOSURE, and whether its values are integers.
    auto_exposure: OpenCV property, and the value that selects manual exposure.
    autos: names and properties of further automatic functions, which the value 0 switches off.
    offsets: properties for the first column and row of the sensor region; None if the backend does
        not support regions.
    buffers: number of frame buffers to request from the driver.
    stamp_fraction: time from the middle of the exposure to the driver's timestamp, as a fraction of
        the exposure time.
    clock: whether the value of CAP_PROP_POS_MSEC after a grab is the driver's timestamp of the
        frame.
    """

    exposure_unit_s: float
    api: int = cv2.CAP_ANY
    whole_units: bool = True
    auto_exposure: tuple[int, float] = (cv2.CAP_PROP_AUTO_EXPOSURE, 0.0)
    autos: tuple[tuple[str, int], ...] = ()
    offsets: tuple[int, int] | None = None
    buffers: int | None = None
    clock: bool = False
    stamp_fraction: float = 0.5


BACKENDS = {
    # V4L2_CID_EXPOSURE_ABSOLUTE has a unit of 100 us; V4L2_EXPOSURE_MANUAL is 1. The driver fills
    # one buffer while the other is read; with one buffer, it can drop every second frame.
    "v4l2": Backend(
        api=cv2.CAP_V4L2,
        exposure_unit_s=1e-4,
        auto_exposure=(cv2.CAP_PROP_AUTO_EXPOSURE, 1.0),
        autos=(
            ("auto white balance", cv2.CAP_PROP_AUTO_WB),
            ("auto focus", cv2.CAP_PROP_AUTOFOCUS),
        ),
        buffers=2,
        clock=True,
    ),
    "ximea": Backend(
        api=cv2.CAP_XIAPI,
        exposure_unit_s=1e-6,
        auto_exposure=(cv2.CAP_PROP_XI_AEAG, 0.0),
        autos=(("auto white balance", cv2.CAP_PROP_XI_AUTO_WB),),
        offsets=(cv2.CAP_PROP_XI_OFFSET_X, cv2.CAP_PROP_XI_OFFSET_Y),
    ),
    # The module `captures` opens the next three backends. OpenCV opens the other backends.
    "aravis": Backend(exposure_unit_s=1e-6, whole_units=False, clock=True),
    "realsense": Backend(exposure_unit_s=1e-6, clock=True, stamp_fraction=0.0),
    "gstreamer": Backend(exposure_unit_s=1.0, whole_units=False, clock=True),
}


@dataclass(frozen=True, slots=True)
class DeviceSettings:
    """The actual settings of a device.

    exposure_s: exposure time; None if it is unknown.
    got: text about the format and the settings, for the log and the status of the node.
    warnings: texts about settings that the device did not accept.
    """

    exposure_s: float | None
    rate_hz: float
    warnings: tuple[str, ...]
    got: str = ""


def choose_backend(device: int | str, api: str | None) -> Backend | None:
    """Choose the OpenCV backend for a device.

    api: name of a backend; None to choose a backend that fits the device.

    Returns None if OpenCV must choose the backend. The units of the camera's controls are then
    unknown.
    """
    if api is None:
        api = "v4l2" if isinstance(device, int) or device.startswith("/dev/") else "any"
    return BACKENDS.get(api)


def set_format(
    capture: Device, backend: Backend | None, camera: StereoCamera, views: int, pixel_format: str
) -> None:
    """Request the image size and frame rate of the scene's camera.

    views: 2 if each image contains both views side by side, otherwise 1.
    pixel_format: four characters such as MJPG, or "" if OpenCV chooses the format.

    The device may ignore the request.
    """
    if backend is not None and backend.buffers is not None:
        capture.set(cv2.CAP_PROP_BUFFERSIZE, backend.buffers)
    if pixel_format:
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*pixel_format))
    if backend is not None and backend.offsets is not None:
        # A region that is still set from a previous use would limit the image size.
        for offset in backend.offsets:
            capture.set(offset, 0.0)
    capture.set(cv2.CAP_PROP_FRAME_WIDTH, views * camera.width_px)
    capture.set(cv2.CAP_PROP_FRAME_HEIGHT, camera.height_px)
    capture.set(cv2.CAP_PROP_FPS, camera.rate_hz)


def fix_settings(
    capture: Device, backend: Backend | None, camera: StereoCamera, device: object
) -> DeviceSettings:
    """Set the scene's exposure and gain, and switch off automatic functions.

    The result contains warnings about all settings that the device did not accept.
    """
    warnings: list[str] = []

    def warn(what: str, requested: str, actual: str) -> None:
        warnings.append(f"camera {device}: {what}: requested {requested}, actual: {actual}")

    rate_hz = capture.get(cv2.CAP_PROP_FPS)
    if not 0.0 < rate_hz <= MAX_RATE_HZ:
        rate_hz = camera.rate_hz
    elif abs(rate_hz - camera.rate_hz) > RATE_TOLERANCE * camera.rate_hz:
        warn("rate", f"{camera.rate_hz:g} Hz", f"{rate_hz:g} Hz")
    if backend is None:
        warn("exposure", f"{1e3 * camera.exposure_s:g} ms", "OpenCV cannot set the exposure")
        text = _describe(capture, device, rate_hz, None)
        return DeviceSettings(None, rate_hz, tuple(warnings), text)

    if backend.api == cv2.CAP_V4L2:
        # An environment variable can make OpenCV scale all controls to 0..1; this prevents it.
        capture.set(cv2.CAP_PROP_MODE, 0.0)
    automatic, manual_value = backend.auto_exposure
    capture.set(automatic, manual_value)
    is_manual = capture.get(automatic) == manual_value
    if not is_manual:
        warn("auto exposure", f"{manual_value:g} (manual)", f"{capture.get(automatic):g}")
    for what, property_id in backend.autos:
        if capture.get(property_id) > 0.0:
            capture.set(property_id, 0.0)
            if capture.get(property_id) > 0.0:
                warn(what, "0 (off)", f"{capture.get(property_id):g}")

    requested = camera.exposure_s / backend.exposure_unit_s
    capture.set(
        cv2.CAP_PROP_EXPOSURE, max(1, round(requested)) if backend.whole_units else requested
    )
    got = capture.get(cv2.CAP_PROP_EXPOSURE)
    rounding = 0.5 if backend.whole_units else 0.0
    if abs(got - requested) > max(EXPOSURE_TOLERANCE * requested, rounding):
        unit = f"units of {1e6 * backend.exposure_unit_s:g} us"
        warn("exposure", f"{requested:g} {unit}", f"{got:g}")
    if camera.gain is not None:
        capture.set(cv2.CAP_PROP_GAIN, camera.gain)
        gain = capture.get(cv2.CAP_PROP_GAIN)
        if abs(gain - camera.gain) > 0.5:
            warn("gain", f"{camera.gain:g}", f"{gain:g}")
    is_known = is_manual and got > 0.0
    exposure_s = got * backend.exposure_unit_s if is_known else None
    text = _describe(capture, device, rate_hz, exposure_s)
    return DeviceSettings(exposure_s, rate_hz, tuple(warnings), text)


def _describe(capture: Device, device: object, rate_hz: float, exposure_s: float | None) -> str:
    width, height, code, gain = (
        capture.get(one)
        for one in (
            cv2.CAP_PROP_FRAME_WIDTH,
            cv2.CAP_PROP_FRAME_HEIGHT,
            cv2.CAP_PROP_FOURCC,
            cv2.CAP_PROP_GAIN,
        )
    )
    letters = bytes(int(code) >> shift & 0xFF for shift in (0, 8, 16, 24)) if code > 0 else b""
    pixel_format = f" {letters.decode('ascii')}" if letters.isalnum() else ""
    exposure = "unknown" if exposure_s is None else f"{1e3 * exposure_s:g} ms"
    return (
        f"{device}: {width:.0f}x{height:.0f} px{pixel_format} at {rate_hz:g} Hz, "
        f"exposure {exposure}, gain {gain:g}"
    )


def set_region(
    capture: Device, backend: Backend | None, requested: Region, camera: StereoCamera
) -> Region | None:
    """Set the region of the sensor that the device reads.

    Returns the actual region, or None if the device reads the full sensor. If the actual region
    does not contain the requested region, the full sensor is used.
    """
    if backend is None or backend.offsets is None:
        return None
    column, row = backend.offsets
    properties = (column, row, cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)

    def set_and_read(region: Region) -> Region:
        # Offset and size limit each other, so set the offset to 0 before the size.
        capture.set(column, 0)
        capture.set(row, 0)
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, region.width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, region.height)
        capture.set(column, region.column)
        capture.set(row, region.row)
        return Region(*(round(capture.get(each)) for each in properties))

    actual = set_and_read(requested)
    if actual.contains(requested):
        return actual
    set_and_read(Region(0, 0, camera.width_px, camera.height_px))
    return None
