"""Test cameras that OpenCV does not support, with the simulated camera of Aravis and with fake
libraries.

The fake libraries have only the functions that the driver uses. No test uses real hardware.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from camera_bench import HEIGHT, WIDTH, load_scene, running

from flexsheet.nodes.camera import captures
from flexsheet.nodes.camera.captures import RealSenseCapture, list_devices
from flexsheet.nodes.camera.image_pair import DeviceError
from flexsheet.nodes.camera.live import CameraReader
from flexsheet.nodes.camera.sources import OpenCvSource
from tests.note_text import note_text

SCENE = load_scene()
SERIAL = "923322071108"


class FakeFrame:
    def __init__(self, rs: FakeRealSense, level: int) -> None:
        self.rs, self.level = rs, level

    def get_data(self) -> Any:
        return np.full((HEIGHT, WIDTH), self.level, np.uint8)

    def get_timestamp(self) -> float:
        return 1e-6 * self.rs.stamp_ns

    def get_frame_timestamp_domain(self) -> str:
        return self.rs.domain

    def supports_frame_metadata(self, _: str) -> bool:
        return self.rs.has_metadata

    def get_frame_metadata(self, what: str) -> int:
        return {"frame_timestamp": 1_007_000, "sensor_timestamp": 1_000_000}[what]


class FakeRealSense(ModuleType):
    """A fake of the package pyrealsense2 with one camera."""

    def __init__(self) -> None:
        super().__init__("pyrealsense2")
        names = ("exposure", "gain", "enable_auto_exposure", "emitter_enabled")
        self.option = SimpleNamespace(**{name: name for name in (*names, "global_time_enabled")})
        self.stream = SimpleNamespace(infrared="infrared")
        self.format = SimpleNamespace(y8="y8")
        self.timestamp_domain = SimpleNamespace(hardware_clock="hardware", global_time="global")
        self.frame_metadata_value = SimpleNamespace(
            frame_timestamp="frame_timestamp", sensor_timestamp="sensor_timestamp"
        )
        self.camera_info = SimpleNamespace(serial_number="serial", name="name")
        self.options: dict[str, float] = {
            "exposure": 8500.0,
            "gain": 16.0,
            "enable_auto_exposure": 1.0,
            "emitter_enabled": 1.0,
            "global_time_enabled": 0.0,
        }
        self.domain, self.has_metadata, self.silent = "global", True, False
        self.stamp_ns = time.time_ns()
        self.enabled: list[tuple[Any, ...]] = []
        self.serial, self.stopped, self.number = "", 0, 0
        device = SimpleNamespace(
            first_depth_sensor=lambda: self,
            get_info=lambda what: {"serial": SERIAL, "name": "D435"}[what],
        )
        self.device = device
        self.context = lambda: SimpleNamespace(query_devices=lambda: [device])

    def config(self) -> Any:
        return SimpleNamespace(
            enable_device=lambda serial: setattr(self, "serial", serial),
            enable_stream=lambda *mode: self.enabled.append(mode),
        )

    def pipeline(self) -> Any:
        return SimpleNamespace(
            start=self.start,
            try_wait_for_frames=self.wait,
            stop=lambda: setattr(self, "stopped", self.stopped + 1),
        )

    def start(self, _: Any) -> Any:
        width, height, rate_hz = self.enabled[0][2], self.enabled[0][3], self.enabled[0][5]
        if (width, height, rate_hz) != (WIDTH, HEIGHT, 60) or self.serial not in {"", SERIAL}:
            raise RuntimeError("Couldn't resolve requests")
        profile = SimpleNamespace(width=lambda: width, height=lambda: height, fps=lambda: rate_hz)
        stream = SimpleNamespace(as_video_stream_profile=lambda: profile)
        return SimpleNamespace(get_device=lambda: self.device, get_stream=lambda *_: stream)

    def supports(self, option: str) -> bool:
        return option in self.options

    def set_option(self, option: str, value: float) -> None:
        if option == "gain" and value > 248.0:
            raise RuntimeError("out of range")
        self.options[option] = value

    def get_option(self, option: str) -> float:
        return self.options[option]

    def wait(self, _: int) -> tuple[bool, Any]:
        if self.silent:
            return False, None
        self.number += 1
        self.stamp_ns = time.time_ns() - 5_000_000
        frames = SimpleNamespace(get_infrared_frame=lambda one: FakeFrame(self, 50 * one))
        return True, frames


@pytest.fixture
def rs(monkeypatch: pytest.MonkeyPatch) -> FakeRealSense:
    module = FakeRealSense()
    monkeypatch.setitem(sys.modules, "pyrealsense2", module)
    return module


def realsense(**source: Any) -> dict[str, Any]:
    return {"kind": "live", "api": "realsense", "left": SERIAL, **source}


async def test_a_realsense_gives_stamped_pairs_with_its_projector_off(rs: FakeRealSense) -> None:
    async with running(SCENE, source=realsense()) as bench:
        await bench.until(lambda: len(bench.sent) >= 3)
        pair, header = bench.sent[-1]
        assert (int(pair.left.mean()), int(pair.right.mean())) == (50, 100)
        assert pair.left.shape == (HEIGHT, WIDTH)
        # The middle of the exposure is 5 ms + 7 ms before the arrival.
        age_s = (time.monotonic_ns() - header.source_ns) * 1e-9
        assert age_s >= 0.012
        assert pair.skew_s == 0.0
        assert pair.exposure_s == pytest.approx(SCENE.camera.exposure_s)
        note = note_text(bench.node)
        assert f"{SERIAL}: {2 * WIDTH}x{HEIGHT} px GREY at 60 Hz, exposure 4 ms" in note
        assert "stamped by the driver" in note
    assert rs.options["emitter_enabled"] == 0.0
    assert rs.options["global_time_enabled"] == 1.0
    assert rs.options["enable_auto_exposure"] == 0.0
    assert {mode[1] for mode in rs.enabled} == {1, 2}
    assert rs.stopped == 1


def test_the_middle_of_the_exposure_is_taken_from_the_metadata(rs: FakeRealSense) -> None:
    capture = RealSenseCapture("")
    for property_id, value in (
        (cv2.CAP_PROP_FRAME_WIDTH, 2 * WIDTH),
        (cv2.CAP_PROP_FRAME_HEIGHT, HEIGHT),
        (cv2.CAP_PROP_FPS, 60),
    ):
        assert capture.set(property_id, float(value))
    assert capture.grab()
    real_ns = rs.stamp_ns - time.time_ns() + time.monotonic_ns()
    assert capture.get(cv2.CAP_PROP_POS_MSEC) == pytest.approx(1e-6 * real_ns - 7.0, abs=1.0)
    rs.has_metadata = False
    assert capture.grab()
    real_ns = rs.stamp_ns - time.time_ns() + time.monotonic_ns()
    assert capture.get(cv2.CAP_PROP_POS_MSEC) == pytest.approx(1e-6 * real_ns, abs=1.0)
    rs.domain = "hardware"
    assert capture.grab()
    assert capture.get(cv2.CAP_PROP_POS_MSEC) == 0.0
    rs.silent = True
    assert not capture.grab()
    assert not capture.set(cv2.CAP_PROP_GAIN, 1000.0)
    capture.release()


def test_a_mode_that_the_camera_lacks_names_device_key_and_remedy(rs: FakeRealSense) -> None:
    source = OpenCvSource.model_validate(realsense(left="000"))
    with pytest.raises(
        DeviceError,
        match="RealSense camera 000 cannot deliver an infrared pair of 160x120 px at 60 Hz",
    ):
        CameraReader(source, SCENE.camera, time.monotonic_ns)


@pytest.mark.parametrize(
    ("api", "module", "remedy"),
    [
        ("realsense", "pyrealsense2", "flexsheet\\[realsense\\]"),
        ("aravis", "gi", "python3-gi"),
        ("gstreamer", "gi", "python3-gi"),
    ],
)
def test_a_missing_library_says_how_to_install_it(
    monkeypatch: pytest.MonkeyPatch, api: str, module: str, remedy: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    source = OpenCvSource.model_validate({"kind": "live", "api": api, "left": "x"})
    with pytest.raises(DeviceError, match=f"cannot import the package {module} .*{remedy}"):
        CameraReader(source, SCENE.camera, time.monotonic_ns)


def test_devices_are_listed_with_their_api(rs: FakeRealSense, tmp_path: Path) -> None:
    (tmp_path / "video0").mkdir()
    (tmp_path / "video0" / "name").write_text("UVC camera\n", encoding="utf-8")
    found = list_devices(tmp_path)
    assert found[0] == "v4l2 /dev/video0 (UVC camera)"
    assert found[-1] == f"realsense {SERIAL} (D435)"


def require(name: str, version: str) -> None:
    try:
        captures._import_introspected(name, version)
    except DeviceError as error:
        pytest.skip(str(error))


async def test_the_simulated_camera_of_aravis_is_read() -> None:
    require("Aravis", "0.8")
    source = {"kind": "live", "api": "aravis", "left": "Fake_1"}
    scene = load_scene(width_px=WIDTH)
    wide = scene.camera.model_copy(update={"rate_hz": 25.0})
    async with running(scene.model_copy(update={"camera": wide}), source=source) as bench:
        await bench.until(lambda: len(bench.sent) >= 5)
        pair, header = bench.sent[-1]
        assert pair.left.shape == pair.right.shape == (HEIGHT, WIDTH)
        assert pair.exposure_s == pytest.approx(SCENE.camera.exposure_s, rel=0.05)
        assert f"Fake_1: {2 * WIDTH}x{HEIGHT} px GREY at 25 Hz" in note_text(bench.node)
        assert "stamped by the driver" in note_text(bench.node)
        steps = np.diff([one.source_ns for _, one in bench.sent])
        assert (steps > 0).all()
        assert header.source_ns <= time.monotonic_ns()


async def test_a_gstreamer_pipeline_is_read() -> None:
    require("Gst", "1.0")
    pipeline = (
        f"videotestsrc is-live=true ! video/x-raw,width={2 * WIDTH},height={HEIGHT},framerate=30/1"
    )
    async with running(
        SCENE, source={"kind": "live", "api": "gstreamer", "left": pipeline}
    ) as bench:
        await bench.until(lambda: len(bench.sent) >= 5)
        pair, _ = bench.sent[-1]
        assert pair.left.shape == pair.right.shape == (HEIGHT, WIDTH)
        assert f"{2 * WIDTH}x{HEIGHT} px at 30 Hz" in note_text(bench.node)
        assert "stamped by the driver" in note_text(bench.node)


def test_a_pipeline_that_gstreamer_rejects_is_an_error() -> None:
    require("Gst", "1.0")
    source = OpenCvSource.model_validate({"kind": "live", "api": "gstreamer", "left": "no_such"})
    with pytest.raises(DeviceError, match="is not a valid GStreamer pipeline"):
        CameraReader(source, SCENE.camera, time.monotonic_ns)
