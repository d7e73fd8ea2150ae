"""Measure the processor time of a frame without OpenGL, from the soft body to the image.

python -m benchmarks.frame_cpu [--scene FILE] [--triangles 20000] [--frames 300]

Renders stereo frames of a pushed sheet, each with a new soft body, by the renderer's code. OpenGL
calls are timed separately, as wall time. `GL calls` is the time of the calls, which return early on
a graphics card, but possibly not with a software driver. `GL finish` is the wait for the image. All
other times are processor times of the rendering thread, so that other load has little effect. The
image is small, because a software driver that fills many pixels evicts the caches, unlike a
graphics card.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.scene import Scene, require_projector
from flexsheet.messages.types import Display, Skin, SoftBody
from flexsheet.nodes.fem_solver.mesh.from_scene import build_mesh, mesh_spec, world_from_mesh
from flexsheet.nodes.models.rigid import apply
from flexsheet.nodes.models.sheet import edge_poses
from flexsheet.nodes.renderer import deflection_cache
from flexsheet.nodes.renderer.gl import headless_context
from flexsheet.nodes.renderer.scene_renderer import SceneRenderer
from flexsheet.nodes.renderer.sheet import SheetPose, estimate_sheet

Floats = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[1]
SKIN_SPACING_M = 0.0045
STRETCH = 1.05
SMALL = 0.1
"""The image size relative to the projector, per axis, while processor time is measured."""
GL_TYPES: tuple[type, ...] = (
    moderngl.Buffer,
    moderngl.Context,
    moderngl.Framebuffer,
    moderngl.Program,
    moderngl.Texture,
    moderngl.Uniform,
    moderngl.VertexArray,
)


class Clock:
    """Times of one frame by name, s, in which calls that are timed apart are not counted twice."""

    def __init__(self) -> None:
        self.spent: dict[str, float] = defaultdict(float)
        self._inside = 0
        self._apart_s = 0.0

    @contextmanager
    def span(self, name: str) -> Iterator[None]:
        begun, before = time.thread_time(), self._apart_s
        yield
        taken = time.thread_time() - begun - (self._apart_s - before)
        self.spent[name] += taken

    def apart(
        self, call: Callable[..., Any], name: str, now: Callable[[], float]
    ) -> Callable[..., Any]:
        """Record the time of the call under `name` and subtract it from the enclosing span."""

        def timed(*args: Any, **rest: Any) -> Any:
            if self._inside:
                return call(*args, **rest)
            self._inside, begun, cpu = 1, now(), time.thread_time()
            try:
                return call(*args, **rest)
            finally:
                self.spent[name] += now() - begun
                self._inside, self._apart_s = 0, self._apart_s + time.thread_time() - cpu

        return timed


@contextmanager
def gl_apart(clock: Clock) -> Iterator[None]:
    """Time every method of moderngl's objects with `clock` in the context."""
    kept: list[tuple[type, str, Any]] = []
    for kind in GL_TYPES:
        for name, method in list(vars(kind).items()):
            plain = callable(method) and (not name.startswith("__") or name == "__setitem__")
            if not plain or isinstance(method, (staticmethod, classmethod)):
                continue
            kept.append((kind, name, method))
            label = "GL finish" if name == "finish" else "GL calls"
            setattr(kind, name, clock.apart(method, label, time.perf_counter))
    try:
        yield
    finally:
        for kind, name, method in kept:
            setattr(kind, name, method)


def with_fewer_pixels(scene: Scene, fraction: float) -> Scene:
    """Return the scene with fewer projector pixels."""
    projector, lens = require_projector(scene), require_projector(scene).lens
    sizes = {name: fraction * getattr(lens, name) for name in ("fx_px", "fy_px", "cx_px", "cy_px")}
    changes = {
        "lens": lens.model_copy(update=sizes),
        "width_px": round(fraction * projector.width_px),
        "height_px": round(fraction * projector.height_px),
    }
    return scene.model_copy(update={"projector": projector.model_copy(update=changes)})


def make_scene_renderer(scene: Scene, triangles: int) -> SceneRenderer:
    """Make a scene renderer whose surface has about this many triangles."""
    spacing_m = 0.0025
    for _ in range(4):
        stage = SceneRenderer(
            scene,
            headless_context(),
            spacing_m=spacing_m,
            basis=deflection_cache.load_or_compute(scene, None),
        )
        have = len(stage._surface.triangles)
        if abs(have - triangles) < 0.05 * triangles:
            break
        spacing_m *= float(np.sqrt(have / triangles))
    return stage


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
    """Return the predicted sheet between two edges; `number` determines the pushed point."""
    tip = np.array([0.02 * np.sin(0.1 * number), 0.02 * np.cos(0.1 * number), -0.015])
    sheet = estimate_sheet(*edges, height_m=scene.sheet.height_m, finger_tip=tip)
    assert sheet is not None
    return sheet


def measure(
    scene: Scene, *, triangles: int, frames: int
) -> tuple[SceneRenderer, list[dict[str, float]]]:
    """Return the seconds of each frame by name."""
    stage, skin = make_scene_renderer(scene, triangles), compute_skin(scene)
    stage.set_skin(skin)
    shown = Display(correction="two_pass", stereo="side_by_side")
    edges = edge_poses(np.eye(4), STRETCH * scene.sheet.width_m)
    rows = []
    clock = Clock()
    shape = clock.apart(stage.sheet_mesh, "sheet's shape", time.thread_time)
    setattr(stage, "sheet_mesh", shape)  # noqa: B010  (mypy rejects an assignment to a method)
    with gl_apart(clock):
        for number, body in zip(range(frames + 20), bodies(skin), strict=False):
            clock.spent = defaultdict(float)
            with clock.span("sheet believed"):
                sheet = predict_sheet(scene, edges, number)
            with clock.span("object shaped"):
                stage.deform(body)
            with clock.span("look and marks"):
                look = stage.draw_style(shown, sheet.pushed_point, None)
            with clock.span("two eyes drawn"):
                stage.draw(shown, sheet, look, read=False)
            rows.append(dict(clock.spent))
    return stage, rows[20:]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default=ROOT / "launch" / "scenes" / "cylinder.yaml", type=Path)
    parser.add_argument("--triangles", default=20_000, type=int)
    parser.add_argument("--frames", default=300, type=int)
    options = parser.parse_args()
    scene = load_scene(options.scene)
    stage, rows = measure(
        with_fewer_pixels(scene, SMALL), triangles=options.triangles, frames=options.frames
    )
    _, full = measure(scene, triangles=options.triangles, frames=options.frames // 5)
    names = [name for name in dict.fromkeys(n for row in rows for n in row) if name[:2] != "GL"]
    skin = stage._deformation.vertices if stage._deformation else 0
    print(
        f"{scene.name}: {len(stage._surface.triangles)} triangles that follow a skin of {skin} "
        f"vertices, two eyes, two_pass, {stage.canvas.context.info['GL_RENDERER']}\n"
    )
    print("| ms | median | p99 |\n|---|---|---|")

    def say(title: str, parts: list[str], rows: list[dict[str, float]]) -> None:
        values = 1e3 * np.array([sum(row.get(part, 0.0) for part in parts) for row in rows])
        print(f"| {title} | {np.median(values):.3f} | {np.quantile(values, 0.99):.3f} |")

    for name in names:
        say(name, [name], rows)
    say("CPU side, all", names, rows)
    for name in ("GL calls", "GL finish"):
        say(
            f"{name}, {require_projector(scene).width_px}x{require_projector(scene).height_px}",
            [name],
            full,
        )


if __name__ == "__main__":
    main()
