"""Fix what a camera would adjust automatically: exposure, gain, white balance, focus, region.

Each setting is read back and compared.  A setting that the device does not accept gives a warning
with property, requested value and the device's value.  Units differ between OpenCV's backends (its
sources: modules/videoio/src/cap_v4l.cpp, cap_ximea.cpp, cap_aravis.cpp).
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
    """Define the part of cv2.VideoCapture that is used here."""

    def get(self, property_id: int, /) -> float: ...

    def set(self, property_id: int, value: float, /) -> bool: ...


@dataclass(frozen=True, slots=True)
class Backend:
    """Hold the names and units of a camera's controls in one of OpenCV's backends.

    exposure_unit_s: unit of CAP_PROP_EXPOSURE, and whether it takes integers.
    auto_exposure: property and its value for manual exposure.
    autos: further automatic functions to switch off (0) where the device has them.
    offsets: properties of the region's first column and row, None where OpenCV has none.
    buffers: number of frames that the driver may hold.
    clock: whether CAP_PROP_POS_MSEC after a grab is the driver's stamp of that frame.
    """

    api: int
    exposure_unit_s: float
    whole_units: bool
    auto_exposure: tuple[int, float]
    autos: tuple[tuple[str, int], ...] = ()
    offsets: tuple[int, int] | None = None
    buffers: int | None = None
    clock: bool = False


BACKENDS = {
    # V4L2_CID_EXPOSURE_ABSOLUTE counts 100 us; V4L2_EXPOSURE_MANUAL is 1.  Two buffers: one that
    # the driver fills while we hold the other.  With one, every second frame may find no room.
    "v4l2": Backend(
        api=cv2.CAP_V4L2,
        exposure_unit_s=1e-4,
        whole_units=True,
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
        whole_units=True,
        auto_exposure=(cv2.CAP_PROP_XI_AEAG, 0.0),
        autos=(("auto white balance", cv2.CAP_PROP_XI_AUTO_WB),),
        offsets=(cv2.CAP_PROP_XI_OFFSET_X, cv2.CAP_PROP_XI_OFFSET_Y),
    ),
    "aravis": Backend(
        api=cv2.CAP_ARAVIS,
        exposure_unit_s=1.0,
        whole_units=False,
        auto_exposure=(cv2.CAP_PROP_AUTO_EXPOSURE, 0.0),
    ),
}


@dataclass(frozen=True, slots=True)
class Settings:
    """Hold a device's settings: exposure (None: not known) and rate, and what it did not accept."""

    exposure_s: float | None
    rate_hz: float
    warnings: tuple[str, ...]


def choose_backend(device: int | str, api: str | None) -> Backend | None:
    """Return the backend to open a device with; None: chosen by OpenCV, with unknown controls."""
    if api is None:
        api = "v4l2" if isinstance(device, int) or device.startswith("/dev/") else "any"
    return BACKENDS.get(api)


def set_format(
    capture: Device, backend: Backend | None, camera: StereoCamera, views: int, pixel_format: str
) -> None:
    """Request the scene's size and rate; the images then show what the device gives.

    views: 2 where one image holds both views side by side.
    pixel_format: "" for OpenCV's choice.
    """
    if backend is not None and backend.buffers is not None:
        capture.set(cv2.CAP_PROP_BUFFERSIZE, backend.buffers)
    if pixel_format:
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*pixel_format))
    if backend is not None and backend.offsets is not None:
        # A region of a previous use would bound the size.
        for offset in backend.offsets:
            capture.set(offset, 0.0)
    capture.set(cv2.CAP_PROP_FRAME_WIDTH, views * camera.width_px)
    capture.set(cv2.CAP_PROP_FRAME_HEIGHT, camera.height_px)
    capture.set(cv2.CAP_PROP_FPS, camera.rate_hz)


def fix_settings(
    capture: Device, backend: Backend | None, camera: StereoCamera, device: object
) -> Settings:
    """Set the scene's exposure and gain, switch everything automatic off, and read all back."""
    warnings: list[str] = []

    def warn(what: str, asked: str, got: str) -> None:
        warnings.append(f"{device}: {what}: asked for {asked}, the device has {got}")

    rate_hz = capture.get(cv2.CAP_PROP_FPS)
    if not 0.0 < rate_hz <= MAX_RATE_HZ:
        rate_hz = camera.rate_hz
    elif abs(rate_hz - camera.rate_hz) > RATE_TOLERANCE * camera.rate_hz:
        warn("rate", f"{camera.rate_hz:g} Hz", f"{rate_hz:g} Hz")
    if backend is None:
        warn("exposure", f"{1e3 * camera.exposure_s:g} ms", "no control that OpenCV can reach")
        return Settings(None, rate_hz, tuple(warnings))

    if backend.api == cv2.CAP_V4L2:
        # Otherwise an environment variable makes OpenCV scale all controls to 0..1.
        capture.set(cv2.CAP_PROP_MODE, 0.0)
    automatic, by_hand = backend.auto_exposure
    capture.set(automatic, by_hand)
    manual = capture.get(automatic) == by_hand
    if not manual:
        warn("auto exposure", f"{by_hand:g} (by hand)", f"{capture.get(automatic):g}")
    for what, property_id in backend.autos:
        if capture.get(property_id) > 0.0:
            capture.set(property_id, 0.0)
            if capture.get(property_id) > 0.0:
                warn(what, "0 (off)", f"{capture.get(property_id):g}")

    asked = camera.exposure_s / backend.exposure_unit_s
    capture.set(cv2.CAP_PROP_EXPOSURE, max(1, round(asked)) if backend.whole_units else asked)
    got = capture.get(cv2.CAP_PROP_EXPOSURE)
    rounding = 0.5 if backend.whole_units else 0.0
    if abs(got - asked) > max(EXPOSURE_TOLERANCE * asked, rounding):
        unit = f"units of {1e6 * backend.exposure_unit_s:g} us"
        warn("exposure", f"{asked:g} {unit}", f"{got:g}")
    if camera.gain is not None:
        capture.set(cv2.CAP_PROP_GAIN, camera.gain)
        gain = capture.get(cv2.CAP_PROP_GAIN)
        if abs(gain - camera.gain) > 0.5:
            warn("gain", f"{camera.gain:g}", f"{gain:g}")
    known = manual and got > 0.0
    return Settings(got * backend.exposure_unit_s if known else None, rate_hz, tuple(warnings))


def set_region(
    capture: Device, backend: Backend | None, wanted: Region, camera: StereoCamera
) -> Region | None:
    """Make the device read a region of its sensor, and return what it reads; None: all of it.

    A device that reads less than requested is set back to the full sensor.
    """
    if backend is None or backend.offsets is None:
        return None
    column, row = backend.offsets
    places = (column, row, cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)

    def bring(region: Region) -> Region:
        # An offset is bounded by the size, and the size by the offset: begin where all is allowed.
        capture.set(column, 0)
        capture.set(row, 0)
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, region.width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, region.height)
        capture.set(column, region.column)
        capture.set(row, region.row)
        return Region(*(round(capture.get(place)) for place in places))

    reads = bring(wanted)
    if reads.holds(wanted):
        return reads
    bring(Region(0, 0, camera.width_px, camera.height_px))
    return None
