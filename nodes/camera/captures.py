"""Read cameras that the Python package of OpenCV does not support.

The classes have the interface of cv2.VideoCapture. The packages that they need are optional, and
are imported when a device is opened. `settings.BACKENDS` defines the units of the controls.
"""

from __future__ import annotations

import importlib
import time
import warnings
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flexsheet.nodes.camera.image_pair import DeviceError, Image

GRAB_S = 1.0
"""The maximum time (s) to wait for a frame, so that the thread can end if no frame arrives."""

BUFFERS = 4


def _import(module: str, remedy: str) -> Any:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ImportWarning)  # Importing gi causes such warnings.
            return importlib.import_module(module)
    except ImportError as error:
        raise DeviceError(f"cannot import the package {module} ({error}); {remedy}") from error


def _import_introspected(name: str, version: str) -> Any:
    remedy = (
        f"install the system packages python3-gi and gir1.2 of {name}, and set "
        "PYTHONPATH=/usr/lib/python3/dist-packages"
    )
    gi = _import("gi", remedy)
    try:
        gi.require_version(name, version)
    except ValueError as error:
        raise DeviceError(f"{error}; {remedy}") from error
    return _import(f"gi.repository.{name}", remedy)


def _monotonic_ms(real_time_ns: int) -> float:
    """Convert a system time (ns since 1970) to a time of the monotonic clock (ms)."""
    return (real_time_ns - time.time_ns() + time.monotonic_ns()) * 1e-6


class CapturedDevice(ABC):
    """The base class of cameras that start their device on its first use.

    stamp_ms: timestamp of the grabbed frame on the monotonic clock; 0 if the timestamp is unknown.
    wanted: requested value of each OpenCV property of the image format.
    actual: values of OpenCV properties that are constant after the start.
    """

    def __init__(self, device: str) -> None:
        self.device = device
        self.stamp_ms = 0.0
        self.image: NDArray[Any] | None = None
        self.wanted = {
            cv2.CAP_PROP_FRAME_WIDTH: 640.0,
            cv2.CAP_PROP_FRAME_HEIGHT: 480.0,
            cv2.CAP_PROP_FPS: 30.0,
        }
        self.actual: dict[int, float] = {}
        self.started = False

    @abstractmethod
    def _start(self) -> None:
        """Start the device with the requested image format. Raises DeviceError if this fails."""

    def _ensure_started(self) -> None:
        if not self.started:
            self._start()
            self.started = True

    def set(self, property_id: int, value: float) -> bool:
        """Set an OpenCV property, and return whether the device accepts the value.

        Properties of the image format can be set only before the device is started.
        """
        if property_id in self.wanted and not self.started:
            self.wanted[property_id] = value
            return True
        if property_id in {cv2.CAP_PROP_FOURCC, cv2.CAP_PROP_BUFFERSIZE}:
            return False
        self._ensure_started()
        return self._set_control(property_id, value)

    def get(self, property_id: int) -> float:
        """Return the present value of an OpenCV property, or 0 if the value is unknown."""
        if property_id == cv2.CAP_PROP_POS_MSEC:
            return self.stamp_ms
        self._ensure_started()
        return self._get_control(property_id)

    def _set_control(self, property_id: int, value: float) -> bool:
        return False

    def _get_control(self, property_id: int) -> float:
        return self.actual.get(property_id, 0.0)

    def retrieve(self) -> tuple[bool, Image | None]:
        """Return the grey image (height, width) that was grabbed last, as (True, image).

        Returns (False, None) if no image was grabbed.
        """
        return self.image is not None, self.image


class AravisCapture(CapturedDevice):
    """A GenICam camera (GigE Vision or USB3 Vision) that is read with the library Aravis.

    device: name of the camera; empty if there is only one camera.
    """

    def __init__(self, device: str) -> None:
        super().__init__(device)
        self._aravis = _import_introspected("Aravis", "0.8")
        if device.startswith("Fake"):
            self._aravis.enable_interface("Fake")
        self._stream: Any = None
        self._camera = self._call(lambda: self._aravis.Camera.new(device or None), "open")

    def _call(self, call: Any, what: str) -> Any:
        """Call a function of the camera library Aravis, and convert its errors to DeviceError.

        what: verb phrase for the error message, for example "start the stream".
        """
        try:
            return call()
        except Exception as error:  # GLib.Error, which is known only after the import.
            raise DeviceError(f"camera {self.device!r}: Aravis cannot {what}: {error}") from error

    def _start(self) -> None:
        camera = self._camera
        width, height = (
            round(self.wanted[one]) for one in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
        )
        self._call(lambda: camera.set_pixel_format_from_string("Mono8"), "set Mono8")
        self._call(lambda: camera.set_region(0, 0, width, height), f"set {width}x{height} px")
        if camera.is_frame_rate_available():
            rate_hz = self.wanted[cv2.CAP_PROP_FPS]
            self._call(lambda: camera.set_frame_rate(rate_hz), f"set {rate_hz:g} Hz")
        self._stream = self._call(lambda: camera.create_stream(None, None), "create a stream")
        for _ in range(BUFFERS):
            self._stream.push_buffer(self._aravis.Buffer.new_allocate(camera.get_payload()))
        self._call(camera.start_acquisition, "start")

    def _set_control(self, property_id: int, value: float) -> bool:
        camera = self._camera
        try:
            if property_id == cv2.CAP_PROP_EXPOSURE:
                camera.set_exposure_time(value)
            elif property_id == cv2.CAP_PROP_GAIN:
                camera.set_gain(value)
            elif property_id == cv2.CAP_PROP_AUTO_EXPOSURE and camera.is_exposure_auto_available():
                camera.set_exposure_time_auto(self._aravis.Auto.OFF)
            else:
                return False
        except Exception:  # GLib.Error; the caller reads the setting back and reports it.
            return False
        return True

    def _get_control(self, property_id: int) -> float:
        camera = self._camera
        if property_id in {cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT}:
            region = camera.get_region()
            return float(region[2 + (property_id == cv2.CAP_PROP_FRAME_HEIGHT)])
        if property_id == cv2.CAP_PROP_FPS:
            return float(camera.get_frame_rate()) if camera.is_frame_rate_available() else 0.0
        if property_id == cv2.CAP_PROP_EXPOSURE:
            return float(camera.get_exposure_time()) if camera.is_exposure_time_available() else 0.0
        if property_id == cv2.CAP_PROP_GAIN:
            return float(camera.get_gain()) if camera.is_gain_available() else 0.0
        if property_id == cv2.CAP_PROP_AUTO_EXPOSURE and camera.is_exposure_auto_available():
            return float(camera.get_exposure_time_auto() != self._aravis.Auto.OFF)
        if property_id == cv2.CAP_PROP_FOURCC:
            return float(cv2.VideoWriter.fourcc(*"GREY"))
        return 0.0

    def grab(self) -> bool:
        """Wait for the next complete frame; return False if no frame arrives within GRAB_S."""
        self._ensure_started()
        end_s = time.monotonic() + GRAB_S
        while (left_s := end_s - time.monotonic()) > 0.0:
            buffer = self._stream.timeout_pop_buffer(round(1e6 * left_s))
            if buffer is None:
                break
            complete = buffer.get_status() == self._aravis.BufferStatus.SUCCESS
            if complete:
                shape = buffer.get_image_height(), buffer.get_image_width()
                self.image = np.frombuffer(buffer.get_data(), np.uint8).reshape(shape).copy()
                # Time at which this computer received the first packet of the frame.
                self.stamp_ms = _monotonic_ms(buffer.get_system_timestamp())
            self._stream.push_buffer(buffer)
            if complete:
                return True
        return False

    def release(self) -> None:
        """Stop and close the camera."""
        if self.started:
            self._camera.stop_acquisition()
        self._stream = self._camera = None


class RealSenseCapture(CapturedDevice):
    """A RealSense camera whose infrared image pair is read as one image with both views.

    device: serial number; empty if any camera may be used.

    The dot projector of the camera is switched off. Both sensors are triggered together. The
    timestamp is the middle of the exposure if the camera reports sensor timestamps.
    """

    def __init__(self, device: str) -> None:
        super().__init__(device)
        remedy = 'install it by `pip install "flexsheet[realsense]"`, and the system package libusb'
        self._rs = _import("pyrealsense2", remedy)
        self._pipeline: Any = None
        self._sensor: Any = None

    def _start(self) -> None:
        rs, wanted = self._rs, self.wanted
        width, height = (
            round(wanted[cv2.CAP_PROP_FRAME_WIDTH] / 2),
            round(wanted[cv2.CAP_PROP_FRAME_HEIGHT]),
        )
        rate_hz = round(wanted[cv2.CAP_PROP_FPS])
        config, pipeline = rs.config(), rs.pipeline()
        if self.device:
            config.enable_device(self.device)
        for index in (1, 2):
            config.enable_stream(rs.stream.infrared, index, width, height, rs.format.y8, rate_hz)
        try:
            profile = pipeline.start(config)
        except RuntimeError as error:
            raise DeviceError(
                f"RealSense camera {self.device or '(any)'} cannot deliver an infrared pair of "
                f"{width}x{height} px at {rate_hz} Hz: {error}; set camera.width_px, height_px and "
                "rate_hz of the scene to a mode that `rs-enumerate-devices` lists"
            ) from error
        self._pipeline, self._sensor = pipeline, profile.get_device().first_depth_sensor()
        for option, value in (
            (rs.option.emitter_enabled, 0.0),
            (rs.option.global_time_enabled, 1.0),
        ):
            if self._sensor.supports(option):
                self._sensor.set_option(option, value)
        stream = profile.get_stream(rs.stream.infrared, 1).as_video_stream_profile()
        self.actual = {
            cv2.CAP_PROP_FRAME_WIDTH: 2.0 * stream.width(),
            cv2.CAP_PROP_FRAME_HEIGHT: float(stream.height()),
            cv2.CAP_PROP_FPS: float(stream.fps()),
            cv2.CAP_PROP_FOURCC: float(cv2.VideoWriter.fourcc(*"GREY")),
        }

    def _option(self, property_id: int) -> Any:
        option = self._rs.option
        return {
            cv2.CAP_PROP_EXPOSURE: option.exposure,
            cv2.CAP_PROP_GAIN: option.gain,
            cv2.CAP_PROP_AUTO_EXPOSURE: option.enable_auto_exposure,
        }.get(property_id)

    def _set_control(self, property_id: int, value: float) -> bool:
        option = self._option(property_id)
        if option is None or not self._sensor.supports(option):
            return False
        try:
            self._sensor.set_option(option, value)
        except RuntimeError:  # Out of range; the caller reads the setting back and reports it.
            return False
        return True

    def _get_control(self, property_id: int) -> float:
        option = self._option(property_id)
        if option is None or not self._sensor.supports(option):
            return super()._get_control(property_id)
        return float(self._sensor.get_option(option))

    def grab(self) -> bool:
        """Wait for the next image pair; return False if no pair arrives within GRAB_S."""
        self._ensure_started()
        found, frames = self._pipeline.try_wait_for_frames(round(1e3 * GRAB_S))
        if not found:
            return False
        left, right = (frames.get_infrared_frame(index) for index in (1, 2))
        self.image = np.hstack([np.asanyarray(one.get_data()) for one in (left, right)])
        self.stamp_ms = self._find_stamp_ms(left)
        return True

    def _find_stamp_ms(self, frame: Any) -> float:
        """Return the mid-exposure time (ms) on the monotonic clock, or 0 if it is unknown."""
        rs = self._rs
        if frame.get_frame_timestamp_domain() == rs.timestamp_domain.hardware_clock:
            return 0.0
        value = rs.frame_metadata_value
        back_us = 0.0
        if all(
            frame.supports_frame_metadata(one)
            for one in (value.frame_timestamp, value.sensor_timestamp)
        ):
            back_us = frame.get_frame_metadata(value.frame_timestamp) - frame.get_frame_metadata(
                value.sensor_timestamp
            )
        return _monotonic_ms(round(1e6 * frame.get_timestamp())) - 1e-3 * back_us

    def release(self) -> None:
        if self._pipeline is not None:
            self._pipeline.stop()
        self._pipeline = self._sensor = None


class GstreamerCapture(CapturedDevice):
    """A camera that is read with a GStreamer pipeline.

    device: description of the pipeline up to raw video, such as `v4l2src device=/dev/video0`.

    The pipeline determines the image format. Its source element provides the timestamps.
    """

    def __init__(self, device: str) -> None:
        super().__init__(device)
        self._gst = _import_introspected("Gst", "1.0")
        self._gst.init(None)
        self._pipeline: Any = None

    def _start(self) -> None:
        gst = self._gst
        text = (
            f"{self.device} ! videoconvert ! video/x-raw,format=GRAY8 ! "
            f"appsink name=sink sync=false max-buffers={BUFFERS} drop=true"
        )
        try:
            self._pipeline = gst.parse_launch(text)
        except Exception as error:  # GLib.Error, which is known only after the import.
            raise DeviceError(
                f"{self.device!r} is not a valid GStreamer pipeline: {error}; correct the camera "
                "node's source"
            ) from error
        self._sink = self._pipeline.get_by_name("sink")
        self._pipeline.use_clock(gst.SystemClock.obtain())
        self._pipeline.set_state(gst.State.PLAYING)
        if not self.grab_sample():
            self.release()
            raise DeviceError(
                f"the GStreamer pipeline {self.device!r} delivers no image; test it with gst-launch"
            )

    def grab_sample(self) -> bool:
        """Wait for the next image of the running pipeline; return False if no image arrives."""
        gst = self._gst
        sample = self._sink.emit("try-pull-sample", round(1e9 * GRAB_S))
        if sample is None:
            return False
        buffer, caps = sample.get_buffer(), sample.get_caps().get_structure(0)
        width, height = caps.get_value("width"), caps.get_value("height")
        found, rate, per = caps.get_fraction("framerate")
        self.actual = {
            cv2.CAP_PROP_FRAME_WIDTH: float(width),
            cv2.CAP_PROP_FRAME_HEIGHT: float(height),
            cv2.CAP_PROP_FPS: rate / per if found and per else 0.0,
        }
        data = np.frombuffer(buffer.extract_dup(0, buffer.get_size()), np.uint8)
        # GStreamer pads the rows of a grey image to multiples of four bytes.
        self.image = data.reshape(height, -1)[:, :width].copy()
        known = buffer.pts != gst.CLOCK_TIME_NONE
        # The system clock of GStreamer is CLOCK_MONOTONIC.
        self.stamp_ms = 1e-6 * (buffer.pts + self._pipeline.get_base_time()) if known else 0.0
        return True

    def grab(self) -> bool:
        """Wait for the next image; return False if the pipeline has ended or delivers no image."""
        self._ensure_started()
        return self.grab_sample()

    def release(self) -> None:
        if self._pipeline is not None:
            self._pipeline.set_state(self._gst.State.NULL)
        self._pipeline = None


CAPTURES: dict[str, type[AravisCapture | GstreamerCapture | RealSenseCapture]] = {
    "aravis": AravisCapture,
    "gstreamer": GstreamerCapture,
    "realsense": RealSenseCapture,
}
"""The capture class for each value of `api` in the camera node's parameter `source`."""


def list_devices(sysfs: Path = Path("/sys/class/video4linux")) -> list[str]:
    """Return a line of text for each connected camera, with its `api` and its name.

    sysfs: folder in which Linux lists video devices.

    A camera is not listed if its optional package is not installed.
    """
    found = []
    for node in sorted(sysfs.glob("video*")):
        try:
            name = (node / "name").read_text(encoding="utf-8").strip()
        except OSError:
            continue
        found.append(f"v4l2 /dev/{node.name} ({name})")
    try:
        aravis = _import_introspected("Aravis", "0.8")
        aravis.update_device_list()
        count = aravis.get_n_devices()
        found += [f"aravis {aravis.get_device_id(number)}" for number in range(count)]
    except DeviceError:
        pass
    try:
        rs = _import("pyrealsense2", "")
        for device in rs.context().query_devices():
            serial = device.get_info(rs.camera_info.serial_number)
            found.append(f"realsense {serial} ({device.get_info(rs.camera_info.name)})")
    except (DeviceError, RuntimeError):
        pass
    return found
