"""Measure frame time, frames per second and lag of the demo's image, and chart them by machine.

python -m benchmarks.frame_rate [--software] [--seconds 10] [--frames 200] [--output docs/charts]

A stereo frame of the demo's scene, 800x600, is drawn alone; then the demo strokes. Each machine is
a point of `correction-frames.json` and `.svg` in the output folder; a new measurement replaces that
of the same machine. Without a graphics card the exit code is 3, unless --software is given.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from flexsheet.launch.experiments.stroke import read_recording, stroke_span_ns
from flexsheet.launch.experiments.trial import run_stroke
from flexsheet.launch.methods.results import describe_load, machine_name
from flexsheet.launch.methods.svg import page_style, save_svg
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.files import write_file
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Display, Skin, SoftBody
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.fem_solver.mesh.from_scene import build_mesh, mesh_spec, world_from_mesh
from flexsheet.nodes.models.rigid import apply
from flexsheet.nodes.models.sheet import edge_poses
from flexsheet.nodes.renderer import deflection_cache
from flexsheet.nodes.renderer.gl import SOFTWARE_DRIVERS, NoOpenGLError, headless_context
from flexsheet.nodes.renderer.parameters import RendererParameters
from flexsheet.nodes.renderer.scene_renderer import SceneRenderer
from flexsheet.nodes.renderer.sheet import SheetPose, estimate_sheet

ROOT = Path(__file__).resolve().parents[1]
SCENE, DEMO = ROOT / "launch" / "scenes" / "cylinder.yaml", ROOT / "launch" / "demo.yaml"
NAME = "correction-frames"
NO_GPU_CODE = 3
WARM_UP = 20
SKIN_SPACING_M = 0.0045
STRETCH = 1.05


def find_driver() -> str:
    """Return the name of the OpenGL driver, or an empty string without OpenGL."""
    try:
        context = headless_context()
    except NoOpenGLError:
        return ""
    name = str(context.info["GL_RENDERER"])
    context.release()
    return name


def compute_skin(scene: Scene) -> Skin:
    """Compute the solver's skin with the demo's spacing."""
    mesh = build_mesh(mesh_spec(scene, SKIN_SPACING_M))
    points = apply(world_from_mesh(scene), mesh.nodes[mesh.skin])
    return Skin(
        mesh_id="bench",
        vertices_world_m=points.astype(np.float32),
        triangles=mesh.skin_triangles,
    )


def bodies(skin: Skin) -> Iterator[SoftBody]:
    """Yield soft bodies pushed 15 mm deep at several points."""
    points = skin.vertices_world_m.astype(np.float64)
    for number in range(10**6):
        place = 0.02 * np.array([np.sin(0.1 * number), np.cos(0.1 * number)])
        away = np.linalg.norm(points[:, :2] - place, axis=1)
        depth = 0.015 * np.exp(-((away / 0.015) ** 2))
        yield SoftBody(
            mesh_id="bench",
            method="bench",
            in_range=True,
            push_depth_m=0.015,
            force_world_n=np.zeros(3),
            stiffness_n_per_m=0.0,
            displacement_world_m=(depth[:, None] * [0.0, 0.0, -1.0]).astype(np.float32),
        )


def predict_sheet(scene: Scene, edges: tuple[Floats, Floats], number: int) -> SheetPose:
    """Return the predicted sheet between two edges.

    number: number of the frame, which determines the pushed point.
    """
    tip = np.array([0.02 * np.sin(0.1 * number), 0.02 * np.cos(0.1 * number), -0.015])
    sheet = estimate_sheet(
        *edges,
        height_m=scene.sheet.height_m,
        twist_world=np.zeros(6),
        ahead_s=0.0,
        finger_tip=tip,
    )
    assert sheet is not None
    return sheet


def measure_frames(scene: Scene, frames: int) -> dict[str, float]:
    """Return the wall time and processor time (ms) of stereo frames.

    Each frame has a new sheet pose and a new soft body.
    """
    given = RendererParameters()
    renderer = SceneRenderer(
        scene,
        headless_context(),
        spacing_m=given.spacing_m,
        samples=given.samples,
        basis=deflection_cache.load_or_compute(scene, None),
    )
    skin = compute_skin(scene)
    renderer.set_skin(skin)
    shown = Display(correction="two_pass", stereo="side_by_side")
    edges = edge_poses(np.eye(4), STRETCH * scene.sheet.width_m)
    wall_s, cpu_s = [], []
    for number, body in zip(range(frames + WARM_UP), bodies(skin), strict=False):
        begun, cpu = time.perf_counter(), time.process_time()
        sheet = predict_sheet(scene, edges, number)
        renderer.deform(body)
        look = renderer.draw_style(shown, sheet.pushed_point, None)
        renderer.draw(shown, sheet, look, read=False)
        wall_s.append(time.perf_counter() - begun)
        cpu_s.append(time.process_time() - cpu)
    wall_ms = 1e3 * np.array(wall_s[WARM_UP:])
    return {
        "frame_ms_p50": float(np.median(wall_ms)),
        "frame_ms_p99": float(np.quantile(wall_ms, 0.99)),
        "frame_cpu_ms": 1e3 * float(np.median(cpu_s[WARM_UP:])),
    }


def measure_stroke(seconds: float) -> dict[str, Any]:
    """Return frames per second, latencies and lags of a stroke in the demo."""
    with tempfile.TemporaryDirectory(prefix="flexsheet-frames-") as folder:
        bag = Path(folder) / "stroke.mcap"
        trial = {"launch_file": str(DEMO), "seconds": seconds, "bag": str(bag)}
        result = run_stroke(trial, None)
        recording = read_recording(bag)
    begin_ns, end_ns = stroke_span_ns(recording, seconds)
    shown = [at_ns for at_ns, _ in recording.frames.sheet if begin_ns <= at_ns <= end_ns]
    return {
        "frames_per_s": 1e9 * (len(shown) - 1) / (shown[-1] - shown[0]),
        "visible_lag_ms": result["visible_lag_ms"],
        "exposure_to_light_ms": result["latency_ms"]["exposure_to_light"],
        "exposure_to_arm_ms": result["latency_ms"]["exposure_to_arm"],
    }


def add_point(point: dict[str, Any], folder: Path) -> list[dict[str, Any]]:
    """Add the point of a machine to the chart in a folder, and return all points."""
    numbers = folder / f"{NAME}.json"
    points = json.loads(numbers.read_text())["points"] if numbers.exists() else []
    same = ("machine", "driver")
    points = [old for old in points if any(old[key] != point[key] for key in same)] + [point]
    folder.mkdir(parents=True, exist_ok=True)
    write_file(numbers, json.dumps({"points": points}, indent=1) + "\n")
    draw_points(points, folder / f"{NAME}.svg")
    return points


def draw_points(points: list[dict[str, Any]], path: Path) -> None:
    """Draw frames per second and the lag of the deflection over the time of a frame."""
    from matplotlib.figure import Figure

    with page_style():
        figure = Figure(figsize=(8, 4.5), layout="constrained")
        rate, lag = figure.subplots(1, 2)
        for point in points:
            driver = point["driver"].partition(" (")[0]
            rate.plot(point["frame_ms_p50"], point["frames_per_s"], "o", label=driver)
            lag.plot(point["frame_ms_p50"], point["visible_lag_ms"]["object"], "o", label=driver)
        rate.set(ylabel="frames per second, demo", ylim=(0, None))
        lag.set(ylabel="visible lag of the deflection, ms")
        for axes in (rate, lag):
            axes.set(xscale="log", xlabel="time of a stereo frame, ms")
        rate.legend()
        save_svg(figure, path)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--software", action="store_true", help="measure a software driver too")
    parser.add_argument("--seconds", type=float, default=10.0, help="duration of the stroke")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--output", type=Path, help="folder of the charts")
    given = parser.parse_args()
    driver = find_driver()
    if not driver or (not given.software and driver.startswith(SOFTWARE_DRIVERS)):
        found = f"OpenGL uses {driver}" if driver else "OpenGL is not available"
        print(
            f"no graphics card: {found}; nothing was measured (--software: measure anyway)",
            file=sys.stderr,
        )
        return NO_GPU_CODE
    point = {
        "machine": machine_name(),
        "driver": driver,
        "load": describe_load(),
        **measure_frames(load_scene(SCENE), given.frames),
        **measure_stroke(given.seconds),
    }
    print(json.dumps(point, indent=1))
    if given.output is not None:
        add_point(point, given.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
