"""Draw the image of one eye into an offscreen, multisampled OpenGL frame."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import moderngl
import numpy as np

from flexsheet.messages.errors import FlexsheetError
from flexsheet.nodes.arrays import Floats, Image, Singles
from flexsheet.nodes.models.shapes.triangles import triangulate_grid
from flexsheet.nodes.renderer.correction import (
    GRAZING_SINE,
    NEAR_M,
    ProjectionScreen,
    sector_normals,
)
from flexsheet.nodes.renderer.lens import ClipLens
from flexsheet.nodes.renderer.object_surface import ObjectSurface

FAR_M = 5.0
SAMPLES = 4
SOFTWARE_DRIVERS = ("llvmpipe", "softpipe", "swrast")
LIGHT = np.array([-0.35, 0.6, 0.72]) / np.linalg.norm([-0.35, 0.6, 0.72])
GRID_PITCH_M = 0.02
SCREEN_PATTERNS = ("grid", "checker", "white")
"""The patterns that can be drawn instead of the object. They are drawn on the imaginary screen,
which is the plane z = 0."""
SOFT_LOOK, FLAT_LOOK = 0, 1
LOOKS = {"coordinate_ramp_x": 2, "coordinate_ramp_y": 3, "grid": 4, "checker": 5, "white": 6}
"""The value of the macro LOOK in the shader `object.frag.glsl` for each pattern."""
TEXTURES = {"none": 0, "speckle": 1, "grid": 2, "image": 3}
MARK_RADIUS_M = 0.003


class NoOpenGLError(FlexsheetError, RuntimeError):
    """Raised if no OpenGL 3.3 context can be created."""

    remedy = "Install the packages for EGL that `flexsheet doctor` names."


@dataclass(frozen=True, slots=True)
class EyeView:
    """The geometry of the image for one eye.

    eye, projector: positions (3,), world frame, m. screen: shape of the sheet for which the image
    is corrected, or None if the image is not corrected. clip_from_screen: matrix (3, 3) from the
    imaginary screen, the plane z = 0, to OpenGL clip coordinates. lens: lens of the projector, or
    None if the lens has no distortion. grey: whether to draw in shades of grey.
    """

    eye: Floats
    projector: Floats
    screen: ProjectionScreen | None
    clip_from_screen: Floats
    lens: ClipLens | None = None
    grey: bool = False


@dataclass(frozen=True, slots=True)
class DrawStyle:
    """The style in which the object is drawn.

    flat: whether to draw the object unshaded. pattern: name of a test pattern, or "object".
    fingertip_mark, target_mark: points (3,) on the undeformed object, world frame, m, at which
    marks are drawn. None means that the mark is not drawn.
    """

    flat: bool
    pattern: str
    fingertip_mark: Floats | None = None
    target_mark: Floats | None = None

    @property
    def is_marked(self) -> bool:
        return self.fingertip_mark is not None or self.target_mark is not None


@dataclass(frozen=True, slots=True)
class ImagePart:
    """The part of the projector's image that one eye sees.

    viewport: left, bottom, width and height, px. channels: whether the red, the green and the blue
    channel are drawn.
    """

    viewport: tuple[int, int, int, int]
    channels: tuple[bool, bool, bool] = (True, True, True)

    @property
    def is_grey(self) -> bool:
        return not all(self.channels)

    @contextmanager
    def of(self, frame: moderngl.Framebuffer) -> Iterator[None]:
        """Return a context manager that restricts drawing in `frame` to this part of the image.

        The part has a viewport and colour channels. On exit, the restriction ends.
        """
        whole = frame.viewport
        frame.viewport, frame.color_mask = self.viewport, (*self.channels, True)
        if self.is_grey:
            frame.clear(0.0, 0.0, 0.0, 1.0)  # This also clears the other eye's depth values.
        try:
            yield
        finally:
            frame.viewport, frame.color_mask = whole, (True, True, True, True)


@dataclass(frozen=True, slots=True)
class SurfaceMaterial:
    """The colour and the texture of the object.

    colour: red, green and blue, from 0 to 1. texture: key of `TEXTURES`. pitch_m: period of the
    procedural textures. image (height, width, 3): texture image, starting with the top row; None if
    there is no texture image. image_from_world (4, 4): map from points of the undeformed object to
    image coordinates. Image coordinates are 0 at the left and bottom edges, and 1 at the opposite
    edges. object_from_world (4, 4): inverse pose of the object.
    """

    colour: tuple[float, float, float]
    texture: str
    pitch_m: float
    image: Image | None
    image_from_world: Floats
    object_from_world: Floats


class Canvas:
    """The OpenGL shaders, meshes and framebuffers for the image of one projector."""

    def __init__(
        self,
        context: moderngl.Context,
        size: tuple[int, int],
        surface: ObjectSurface,
        material: SurfaceMaterial,
        *,
        samples: int = SAMPLES,
    ) -> None:
        """Allocate the framebuffers and buffers.

        size: width and height of the image, px. samples: number of samples per pixel
        (multisampling), limited to the maximum of the driver.
        """
        self.width_px, self.height_px = size
        self.context = context
        self._programs = Programs(context, "object")
        samples = min(samples, context.max_samples)
        self._frame = context.framebuffer(
            context.renderbuffer(size, 4, samples=samples),
            context.depth_renderbuffer(size, samples=samples),
        )
        picture = context.renderbuffer(size, 4)
        self.resolved = context.framebuffer(picture)
        # The same image with a depth buffer, for drawing without multisampling.
        self._single = context.framebuffer(picture, context.depth_renderbuffer(size))
        self.target = self._frame
        context.enable(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        self._texture = TEXTURES[material.texture]
        self._material: dict[str, object] = {
            "object_colour": material.colour,
            "texture_pitch_m": material.pitch_m,
            "image_from_world": tuple(material.image_from_world.T.ravel().tolist()),
            "object_from_world": tuple(material.object_from_world.T.ravel().tolist()),
        }
        self._image: moderngl.Texture | None = None
        if material.image is not None:
            height, width = material.image.shape[:2]
            rows = np.ascontiguousarray(material.image[::-1])
            self._image = context.texture((width, height), 3, rows, alignment=1)
            self._image.build_mipmaps()
            self._image.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
            self._image.repeat_x = self._image.repeat_y = False
        self._object = _MeshBuffers(context, surface)
        self._grid = _MeshBuffers(context, _grid_surface())

    def set_shape(self, moved: Singles) -> None:
        """Set the current positions (m) and normals of the object's vertices, as an array (n, 6).

        The normals can have any length. Raises ValueError if the array has another shape.
        """
        self._object.move(moved)

    def begin(self, *, multisampled: bool) -> None:
        """Set `target` to the framebuffer for the next image, and clear this framebuffer."""
        self.target = self._frame if multisampled else self._single
        self.target.clear(0.0, 0.0, 0.0, 1.0)

    def draw_into(self, frame: moderngl.Framebuffer, view: EyeView, look: DrawStyle) -> None:
        """Draw the object, or a pattern on the imaginary screen, into a cleared framebuffer."""
        mesh = self._grid if look.pattern in SCREEN_PATTERNS else self._object
        if look.pattern == "black":
            return
        frame.use()
        # A projector behind the screen draws a mirrored image, which reverses front faces.
        mirrored = np.linalg.det(view.clip_from_screen) < 0.0
        self.context.front_face = "cw" if mirrored else "ccw"
        program, uniforms = self._program(view, look)
        set_view(uniforms, view)
        uniforms.set(
            **self._material,
            grid_pitch_m=GRID_PITCH_M,
            light_direction=tuple(LIGHT.tolist()),
            fingertip_mark=_mark(look.fingertip_mark),
            target_mark=_mark(look.target_mark),
        )
        if self._image is not None:
            self._image.use()
        mesh.array(program).render(moderngl.TRIANGLES)

    def _program(self, view: EyeView, look: DrawStyle) -> tuple[moderngl.Program, Uniforms]:
        number = LOOKS.get(look.pattern, FLAT_LOOK if look.flat else SOFT_LOOK)
        return self._programs.get(
            LOOK=number,
            TEXTURE=self._texture if number == SOFT_LOOK else 0,
            MARKS=number in (SOFT_LOOK, FLAT_LOOK) and look.is_marked,
            CORRECTED=view.screen is not None,
            LENS=view.lens is not None,
            GREY=view.grey,
        )

    def resolve(self) -> None:
        """Average the samples of a multisampled image into the framebuffer `resolved`."""
        if self.target is self._frame:
            self.context.copy_framebuffer(self.resolved, self._frame)

    def read(self) -> Image:
        """Return the last image (height, width, 3), starting with the top row."""
        data = self.resolved.read(components=3, alignment=1)
        rows = np.frombuffer(data, np.uint8).reshape(self.height_px, self.width_px, 3)
        return np.ascontiguousarray(rows[::-1])

    def shifted_points(self, view: EyeView) -> Floats:
        """Return the vertex positions that the shader computes for the image correction.

        The result (n, 4) contains the position (m) and the validity (0 or 1) of each of the n
        vertices. Tests compare the result with a reference.
        """
        text = shader_text("object.vert.glsl", CORRECTED=view.screen is not None, LENS=False)
        program = self.context.program(vertex_shader=text, varyings=("shifted",))
        set_view(Uniforms(program), view)
        self._frame.use()  # Transform feedback without a window requires a bound framebuffer.
        captured = self.context.buffer(reserve=self._object.count * 16)
        self._object.array(program, indexed=False).transform(captured, moderngl.POINTS)
        return np.frombuffer(captured.read(), np.float32).reshape(-1, 4).astype(np.float64)


def _mark(point: Floats | None) -> tuple[float, ...]:
    return (0.0,) * 4 if point is None else (*point.tolist(), MARK_RADIUS_M)


class Uniforms:
    """The uniforms (parameters) of a shader program. Only changed values are written to OpenGL."""

    def __init__(self, program: moderngl.Program) -> None:
        self._program = program
        self._last: dict[str, object] = dict.fromkeys(program)

    def set(self, **values: object) -> None:
        """Set uniforms by name, and ignore uniforms that the compiler has removed as unused."""
        last = self._last
        for name, value in values.items():
            if name in last and last[name] != value:
                self._program[name] = last[name] = value


class Programs:
    """The variants of a shader program with different values of its macros.

    Each variant is compiled on first use.
    """

    def __init__(self, context: moderngl.Context, name: str) -> None:
        self._context, self._name = context, name
        self._variants: dict[tuple[int, ...], tuple[moderngl.Program, Uniforms]] = {}

    def get(self, **macros: int) -> tuple[moderngl.Program, Uniforms]:
        """Return the shader program for the given macro values, and the program's uniforms.

        Every call must pass the same macros in the same order.
        """
        key = tuple(macros.values())
        if key not in self._variants:
            program = self._context.program(
                vertex_shader=shader_text(f"{self._name}.vert.glsl", **macros),
                fragment_shader=shader_text(f"{self._name}.frag.glsl", **macros),
            )
            self._variants[key] = program, Uniforms(program)
        return self._variants[key]


def set_view(uniforms: Uniforms, view: EyeView) -> None:
    """Set the uniforms of the vertex shader for the image of one eye."""
    screen = view.screen
    uniforms.set(
        eye=tuple(view.eye.tolist()),
        projector=tuple(view.projector.tolist()),
        grazing_sine=GRAZING_SINE,
        near_m=NEAR_M,
        far_m=FAR_M,
        clip_from_screen=tuple(view.clip_from_screen.T.ravel().tolist()),
    )
    if screen is not None:
        uniforms.set(
            sheet_point=tuple(screen.point.tolist()),
            sheet_normals=[tuple(row) for row in screen.normals.tolist()],
            sector_normals=[tuple(row) for row in sector_normals(screen, view.eye).tolist()],
        )
    if view.lens is not None:
        uniforms.set(
            lens=view.lens.focal_centre,
            lens_distortion=view.lens.distortion,
            lens_reach=view.lens.reach,
        )


class _MeshBuffers:
    """The OpenGL buffers of one mesh: its constant rest shape, and its current shape."""

    def __init__(self, context: moderngl.Context, surface: ObjectSurface) -> None:
        self.count = len(surface.rest_world_m)
        self._context = context
        content = surface.interleaved
        self._rest, self._moving = context.buffer(content), context.buffer(content, dynamic=True)
        self._triangles = context.buffer(np.ascontiguousarray(surface.triangles, np.int32))
        self._arrays: dict[tuple[int, bool], moderngl.VertexArray] = {}

    def move(self, moved: Singles) -> None:
        """Set the current positions (m) and normals of the vertices, given as one array (n, 6).

        Raises ValueError if the array has another shape.
        """
        if moved.shape != (self.count, 6):
            raise ValueError(
                f"positions and normals of the mesh: expected shape ({self.count}, 6), found "
                f"{moved.shape}; pass one row for each vertex"
            )
        # Use new memory for each frame, so that the driver need not wait for the previous frame.
        self._moving.orphan()
        self._moving.write(moved)

    def array(self, program: moderngl.Program, *, indexed: bool = True) -> moderngl.VertexArray:
        key = (program.glo, indexed)
        if key not in self._arrays:
            content: list[tuple[object, ...]] = [(self._moving, "3f 3f", "position", "normal")]
            if "rest_position" in program:
                content.append((self._rest, "3f 3f", "rest_position", "rest_normal"))
            self._arrays[key] = self._context.vertex_array(
                program, content, self._triangles if indexed else None, skip_errors=True
            )
        return self._arrays[key]


def _grid_surface() -> ObjectSurface:
    """Return the mesh of a square with sides of 300 mm on the plane z = 0."""
    cells = 60
    axis = np.linspace(-0.15, 0.15, cells + 1)
    x, y = np.meshgrid(axis, axis)
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    return ObjectSurface(points, normals, triangulate_grid(cells + 1, cells + 1))


def shader_text(name: str, **macros: int) -> str:
    """Return the text of a shader file, with macro definitions and expanded `#include` lines.

    name: name of the file. macros: value of each macro.
    """
    text = files("flexsheet.nodes.renderer").joinpath(name).read_text()
    text = re.sub(r'^#include "(.+)"$', lambda line: shader_text(line[1]), text, flags=re.MULTILINE)
    defined = "".join(f"\n#define {macro} {int(value)}" for macro, value in macros.items())
    return re.sub(r"^#version.*$", lambda line: line[0] + defined, text, flags=re.MULTILINE)


def limit_driver_threads() -> None:
    """Limit the threads of a software OpenGL driver to half of the cores.

    The other half remains free for other nodes. If there are at most two cores, the driver starts
    no threads of its own. Its threads would wait for one another on busy cores, which uses
    additional processor time. If the environment variable LP_NUM_THREADS is set, its value is used
    instead.
    """
    cores = len(os.sched_getaffinity(0))
    os.environ.setdefault("LP_NUM_THREADS", str(cores // 2 if cores > 2 else 0))


def is_software(context: moderngl.Context) -> bool:
    """Return whether the OpenGL driver uses the processor instead of a graphics card."""
    return str(context.info["GL_RENDERER"]).startswith(SOFTWARE_DRIVERS)


def headless_context() -> moderngl.Context:
    """Return an OpenGL 3.3 context without a window. Raises NoOpenGLError if EGL fails."""
    limit_driver_threads()
    # The type stub accepts further settings only as a dict.
    settings: dict[str, Any] = {"backend": "egl"}
    try:
        return moderngl.create_context(standalone=True, require=330, **settings)
    except Exception as error:
        raise NoOpenGLError(
            f"OpenGL 3.3 is not available through EGL: {error}; "
            "on Debian or Ubuntu, install it with: apt-get install libegl1 libgl1-mesa-dri"
        ) from error
