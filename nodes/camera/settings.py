"""Fixes what a camera would choose by itself: exposure, gain, white balance, focus, region.

Everything that is set is read back and compared; what a device does not take is told as a warning
that names property, asked value and the device's value.  Units differ between OpenCV's backends
(its sources: modules/videoio/src/cap_v4l.cpp, cap_ximea.cpp, cap_aravis.cpp).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2

from messages.scene import StereoCamera
from nodes.camera.image_pair import Region

EXPOSURE_TOLERANCE = 0.05
RATE_TOLERANCE = 0.02
MAX_RATE_HZ = 10_000.0


class Device(Protocol):
    """What is used of cv2.VideoCapture here."""

    def get(self, property_id: int, /) -> float: ...

    def set(self, property_id: int, value: float, /) -> bool: ...


@dataclass(frozen=True, slots=True)
class Backend:
    """What one of OpenCV's backends calls a camera's controls.

    exposure_unit_s: what CAP_PROP_EXPOSURE counts, and whether in whole numbers.
    auto_exposure: property and the value that means "by hand".
    autos: further things to be switched off (0) where the device has them.
    offsets: properties of the region's first column and row, None where OpenCV has none.
    buffers: frames that the driver may hold.
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
    # the driver fills while we hold the other; with one, every second frame may find no room.
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
    """What a device was brought to: exposure (None: not known) and rate, and what it refused."""

    exposure_s: float | None
    rate_hz: float
    warnings: tuple[str, ...]


def choose_backend(device: int | str, api: str | None) -> Backend | None:
    """The backend to open a device with; None: whichever OpenCV finds, its controls unknown."""
    if api is None:
        api = "v4l2" if isinstance(device, int) or device.startswith("/dev/") else "any"
    return BACKENDS.get(api)


def set_format(
    capture: Device, backend: Backend | None, camera: StereoCamera, views: int, pixel_format: str
) -> None:
    """Ask for the scene's size and rate; what the device then gives is checked by its pictures.

    views: 2 where one picture holds both views side by side.  pixel_format: "" for OpenCV's choice.
    """
    if backend is not None and backend.buffers is not None:
        capture.set(cv2.CAP_PROP_BUFFERSIZE, backend.buffers)
    if pixel_format:
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*pixel_format))
    if backend is not None and backend.offsets is not None:
        # A region left over from before would bound the size.
        for offset in backend.offsets:
            capture.set(offset, 0.0)
    capture.set(cv2.CAP_PROP_FRAME_WIDTH, views * camera.width_px)
    capture.set(cv2.CAP_PROP_FRAME_HEIGHT, camera.height_px)
    capture.set(cv2.CAP_PROP_FPS, camera.rate_hz)


def fix_settings(
    capture: Device, backend: Backend | None, camera: StereoCamera, device: object
) -> Settings:
    """Fix exposure and gain as the scene has them, everything automatic off; read all back."""
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
    """Have the device read a region of its sensor only; what it reads then, None: all of it.

    A device that reads less than was wanted, for want of such places, is set back.
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
