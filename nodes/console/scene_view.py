"""Draw the 3D view of the page, and update the parts that change."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from flexsheet.messages.scene import ArmSpec, Scene
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.console.arms import (
    CLAMP_SIZE_M,
    make_bracket,
    make_hull,
    make_pieces,
    rounded_box,
)
from flexsheet.nodes.console.creases import split_creases
from flexsheet.nodes.console.sheet import COLUMNS, ROWS, TRIANGLES, compute_sheet_points
from flexsheet.nodes.console.snapshot import SceneSnapshot, rays, select_ray_vertices
from flexsheet.nodes.models.rigid import (
    apply,
    pose_matrix,
    quaternion_from_rotation,
    rotation_from_vector,
    transform,
)

Color = tuple[int, int, int]

ARM: Color = (222, 226, 232)
ARM_DARK: Color = (74, 85, 104)
SHEET: Color = (247, 236, 214)
SHEET_LINES: Color = (150, 123, 84)
OBJECT: Color = (214, 97, 84)
FINGER: Color = (236, 188, 160)
FINGER_LOST: Color = (148, 148, 148)
TO_EYE: Color = (196, 110, 0)
FROM_PROJECTOR: Color = (0, 108, 148)
EYE: Color = (250, 250, 250)

GRID: Color = (176, 181, 189)
"""The colour of the floor grid's lines, which are visible on light and dark pages."""

GRID_SECTION: Color = (128, 135, 146)
"""The colour of the floor grid's main lines, which are visible on light and dark pages."""

SHEET_LIFT_M, LINES_LIFT_M = 0.0006, 0.0009
"""The distances by which the sheet and its lines are drawn nearer to the viewer. Without these
distances, a flat object in the plane of the sheet would flicker."""

LINES_EVERY = 5
FINGER_LENGTH_M = 0.05
FINGER_TILT_RAD = 0.6
FINGER_NAME_M = (0.0, -0.06, 0.04)
"""The position (m) of the finger's label relative to the fingertip."""
NAME_ABOVE_M = np.array([0.0, 0.05, 0.0])
FLOOR_M = 0.02
"""The distance of the drawn floor below the bases of the arms."""

LAYERS = ("Arms", "Sheet", "Object", "Finger", "Rays", "Devices", "Names")
EYE_VIEW = "the eye"
VIEWPOINTS: dict[str, tuple[Any, Any] | None] = {
    "afar": ((0.5, 0.34, 1.3), (0.0, -0.13, 0.0)),
    "near": ((0.13, 0.1, 0.6), (0.0, 0.0, 0.0)),
    EYE_VIEW: None,
}
"""The camera position and the target point (m, world frame) of each view. The value is None for the
view from the user's eyes."""

Drag = Callable[[Floats, Floats], None]
"""A callback for a ray from the viewer's eye through the pointer, in the world frame. Its arguments
are the origin (3,), m, and the direction (3,) of the ray."""


class SceneView:
    """The 3D view of the scene. All viewers see the same view."""

    def __init__(self, server: viser.ViserServer, touched: Drag) -> None:
        """Set the lights and the first camera position.

        touched: callback for each position of the pointer while it is pressed on the object.
        """
        self._server, self._scene, self._touched = server, server.scene, touched
        self._shown = dict.fromkeys(LAYERS, True)
        self._layers: dict[str, list[Any]] = {}
        self._links: dict[str, list[Any]] = {}
        self._posed: set[str] = set()
        self._of_scene: Scene | None = None
        self._skin_shape: tuple[int, ...] | None = None
        self._scene.set_up_direction("+y")
        # Without a graphics card, shadows would take most of the drawing time.
        self._scene.configure_default_lights(cast_shadow=False)
        first = next(iter(VIEWPOINTS.values()))
        assert first is not None  # the first viewpoint needs no scene
        server.initial_camera.position, server.initial_camera.look_at = first
        server.initial_camera.fov = 0.75

    def look_from(self, client: viser.ClientHandle, name: str) -> None:
        """Set the camera of one viewer to a view of `VIEWPOINTS`."""
        viewpoint, scene = VIEWPOINTS[name], self._of_scene
        if viewpoint is None:
            if scene is None:
                return
            viewpoint = scene.eyes.centre_world_m, np.zeros(3)
        position, target = viewpoint
        with client.atomic():
            client.camera.up_direction = (0.0, 1.0, 0.0)
            client.camera.position, client.camera.look_at = position, target

    def show_layer(self, layer: str, shown: bool) -> None:
        """Show or hide a layer of the 3D view."""
        self._shown[layer] = shown
        for handle in self._layers.get(layer, []):
            handle.visible = shown
        for side, frames in self._links.items():
            # An arm becomes visible with its first pose.
            for handle in frames:
                handle.visible = self._shown["Arms"] and side in self._posed

    def set_scene(self, scene: Scene) -> None:
        """Draw all parts of the 3D view for a new scene."""
        self._scene.reset()
        self._layers = {layer: [] for layer in LAYERS}
        self._of_scene, self._skin_shape, self._posed = scene, None, set()
        self._add_floor(scene)
        self._links = {
            "left": self._add_arm("left", scene.arms.left, scene.sheet.height_m),
            "right": self._add_arm("right", scene.arms.right, scene.sheet.height_m),
        }
        self.show_layer("Arms", self._shown["Arms"])
        self._add_sheet(scene)
        self._add_finger(scene.finger.radius_m)
        self._add_devices(scene)
        ends = np.zeros((1, 2, 3))
        self._rays = [
            self._add("Rays", self._lines("/rays/eye", ends, TO_EYE, 1.6)),
            self._add("Rays", self._lines("/rays/projector", ends, FROM_PROJECTOR, 1.6)),
        ]

    def set_skin(self, rest: Floats, triangles: NDArray[np.int32]) -> None:
        """Draw the object as the surface mesh of the soft-body solver.

        rest: n vertices (n, 3) of the undeformed object, world frame, m.
        triangles: vertex indices (t, 3) of the t triangles.
        """
        self._skin_source, split = split_creases(rest, triangles)
        corners = _f32(rest[self._skin_source])
        self._object = self._add(
            "Object", self._scene.add_mesh_simple("/object", corners, split, color=OBJECT)
        )
        highest_m = float(rest[:, 1].max())
        self._add_name("/object/name", "virtual object", (0.0, highest_m + 0.01, 0.0))
        self._skin_shape, self._ray_vertices = rest.shape, select_ray_vertices(rest)
        self._make_touchable(self._object)

    def draw(self, snapshot: SceneSnapshot) -> None:
        """Update all poses and meshes of the 3D view to the state in `snapshot`."""
        scene = self._of_scene
        if scene is None:
            return
        with self._server.atomic():
            for side, poses in snapshot.links.items():
                if side not in self._posed:
                    self._posed.add(side)
                    self.show_layer("Arms", self._shown["Arms"])
                for handle, pose in zip(self._links[side], poses, strict=False):
                    _set_pose(handle, pose)
                _set_pose(self._links[side][-1], snapshot.edges[side])
            if snapshot.sheet is not None:
                self._sheet.vertices = _f32(lift_sheet(snapshot.sheet, SHEET_LIFT_M))
                lines = make_line_segments(lift_sheet(snapshot.sheet, LINES_LIFT_M))
                self._sheet_lines.points = _f32(lines)
            if snapshot.skin is not None and snapshot.skin.shape == self._skin_shape:
                self._object.vertices = _f32(snapshot.skin[self._skin_source])
            if snapshot.finger is not None:
                self._finger.position = snapshot.finger
                self._finger.color = FINGER if snapshot.finger_valid else FINGER_LOST
            self._draw_rays(scene, snapshot)

    def _draw_rays(self, scene: Scene, snapshot: SceneSnapshot) -> None:
        if snapshot.sheet is None or snapshot.skin is None or not self._shown["Rays"]:
            return
        if snapshot.skin.shape != self._skin_shape:
            return
        found = rays(scene, snapshot.sheet, snapshot.skin[self._ray_vertices])
        for handle, segments in zip(self._rays, found, strict=True):
            if len(segments):
                handle.points = _f32(segments)

    def _add(self, layer: str, handle: Any) -> Any:
        handle.visible = self._shown[layer]
        self._layers[layer].append(handle)
        return handle

    def _add_floor(self, scene: Scene) -> None:
        lowest = min(
            arm.world_from_base.position_m[1] for arm in (scene.arms.left, scene.arms.right)
        )
        self._scene.add_grid(
            "/floor",
            width=2.4,
            height=2.4,
            plane="xz",
            cell_size=0.1,
            section_size=0.6,
            cell_color=GRID,
            section_color=GRID_SECTION,
            position=(0.0, lowest - FLOOR_M, 0.0),
        )

    def _add_arm(self, side: str, arm: ArmSpec, height_m: float) -> list[Any]:
        """Add the links, the bracket and the clamp of an arm, and return their frames."""
        frames = [
            self._add("Arms", self._scene.add_frame(f"/{side}/{link}", show_axes=False))
            for link in range(7)
        ]
        for i, piece in enumerate(make_pieces(arm.model)):
            vertices, triangles = rounded_box(piece.size_m, piece.centre_m)
            self._scene.add_mesh_simple(
                f"/{side}/{piece.link}/{i}",
                _f32(vertices),
                triangles,
                color=ARM_DARK if piece.dark else ARM,
                flat_shading=True,
            )
        self._scene.add_mesh_simple(
            f"/{side}/6/bracket",
            *make_bracket(np.asarray(arm.flange_from_edge.position_m)),
            color=ARM_DARK,
            flat_shading=True,
        )
        clamp = self._add("Arms", self._scene.add_frame(f"/{side}/clamp", show_axes=False))
        across, along, through = CLAMP_SIZE_M
        vertices, triangles = rounded_box((across, along * height_m, through), (0.0, 0.0, 0.0))
        self._scene.add_mesh_simple(
            f"/{side}/clamp/bar", _f32(vertices), triangles, color=ARM_DARK, flat_shading=True
        )
        self._add_name(f"/names/{side}", f"{side} arm", arm.world_from_base.position_m)
        return [*frames, clamp]

    def _add_sheet(self, scene: Scene) -> None:
        half = 0.5 * scene.sheet.width_m
        points = compute_sheet_points(
            transform(np.eye(3), (-half, 0.0, 0.0)),
            transform(np.eye(3), (half, 0.0, 0.0)),
            height_m=scene.sheet.height_m,
            fingertip=None,
            finger_radius_m=scene.finger.radius_m,
        )
        assert points is not None  # the width of the scene's sheet is positive
        self._sheet = self._add(
            "Sheet",
            self._scene.add_mesh_simple(
                "/sheet",
                _f32(lift_sheet(points, SHEET_LIFT_M)),
                TRIANGLES,
                color=SHEET,
                opacity=0.5,
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            ),
        )
        segments = make_line_segments(lift_sheet(points, LINES_LIFT_M))
        lines = self._lines("/sheet_lines", segments, SHEET_LINES, 1.0)
        self._sheet_lines = self._add("Sheet", lines)
        top_m = 0.5 * scene.sheet.height_m + 0.012
        self._add_name("/right/clamp/name", "rubber sheet", (0.0, top_m, 0.0))
        self._make_touchable(self._sheet)

    def _add_finger(self, radius_m: float) -> None:
        vertices, triangles = make_finger_mesh(radius_m)
        self._finger = self._add(
            "Finger",
            self._scene.add_mesh_simple("/finger", _f32(vertices), triangles, color=FINGER),
        )
        self._finger.position = (0.0, 0.0, 0.08)
        self._add_name("/finger/name", "finger", FINGER_NAME_M)

    def _add_devices(self, scene: Scene) -> None:
        camera = scene.camera
        left = pose_matrix(camera.world_from_left)
        baseline_m = -float(camera.right_from_left[0, 3])
        self._add_device(
            "/devices/camera",
            left,
            ((baseline_m + 0.05, 0.035, 0.045), (0.5 * baseline_m, 0.0, -0.024)),
            [(0.0, 0.0, 0.0), (baseline_m, 0.0, 0.0)],
            0.011,
        )
        centre = apply(left, np.array([0.5 * baseline_m, 0.0, 0.0]))
        self._add_name("/names/camera", "stereo camera", centre + NAME_ABOVE_M)
        if scene.projector is not None:
            pose = pose_matrix(scene.projector.world_from_projector)
            self._add_device(
                "/devices/projector",
                pose,
                ((0.16, 0.07, 0.12), (0.0, 0.0, -0.065)),
                [(0.0, 0.0, -0.005)],
                0.02,
            )
            self._add_name("/names/projector", "projector", pose[:3, 3] + NAME_ABOVE_M)
        eyes_m = scene.eyes.centre_world_m
        self._add_name("/names/eyes", "user's eyes", eyes_m + 0.4 * NAME_ABOVE_M)
        half = 0.5 * scene.eyes.interocular_m
        for name, offset in (("left", -half), ("right", half)):
            eye = self._scene.add_icosphere(
                f"/devices/eye_{name}",
                radius=0.011,
                color=EYE,
                position=eyes_m + np.array([offset, 0.0, 0.0]),
            )
            self._add("Devices", eye)
            self._scene.add_icosphere(
                f"/devices/eye_{name}/pupil", radius=0.006, color=TO_EYE, position=(0, 0, -0.0065)
            )

    def _add_name(self, node: str, text: str, position: Any) -> None:
        label = self._scene.add_label(
            node,
            text,
            position=position,
            font_screen_scale=0.9,
            anchor="bottom-center",
            depth_test=False,
        )
        self._add("Names", label)

    def _add_device(
        self,
        name: str,
        pose: Floats,
        box: tuple[tuple[float, float, float], tuple[float, float, float]],
        lenses: list[tuple[float, float, float]],
        lens_radius_m: float,
    ) -> None:
        vertices, triangles = rounded_box(*box)
        body = self._scene.add_mesh_simple(
            name, _f32(vertices), triangles, color=ARM_DARK, flat_shading=True
        )
        _set_pose(body, pose)
        self._add("Devices", body)
        for i, lens in enumerate(lenses):
            self._scene.add_icosphere(
                f"{name}/lens_{i}", radius=lens_radius_m, color=FROM_PROJECTOR, position=lens
            )

    def _lines(self, name: str, segments: Floats, color: Color, width: float) -> Any:
        return self._scene.add_line_segments(
            name, _f32(segments), color, thickness=width, thickness_units="screen"
        )

    def _make_touchable(self, handle: Any) -> None:
        # Coroutines run in the server's own event loop, which keeps the order of the mouse events.
        async def dragged(event: Any) -> None:
            if event.phase != "end":
                eye = np.array(event.client.camera.position)
                self._touched(eye, np.array(event.end_position) - eye)

        async def clicked(event: Any) -> None:
            self._touched(np.array(event.ray_origin), np.array(event.ray_direction))

        handle.on_drag("left")(dragged)
        handle.on_click(clicked)


def lift_sheet(points: Floats, lift_m: float) -> Floats:
    """Move the sheet's n points (n, 3), in m, by `lift_m` towards the user, along the mean normal.

    In the 3D view, a flat object in the plane of the sheet would otherwise flicker.
    """
    first, last = points[0], points[-1]
    right, left = points[COLUMNS - 1], points[-COLUMNS]
    normal = np.cross(right - left, last - first)
    return np.asarray(points + lift_m * normal / np.linalg.norm(normal))


def make_line_segments(points: Floats) -> Floats:
    """Return k line segments (k, 2, 3), m, along every fifth row and column of the sheet.

    points: n vertices (n, 3) of the sheet.
    """
    grid = points.reshape(ROWS, COLUMNS, 3)
    lines = np.concatenate([grid[::LINES_EVERY], grid[:, ::LINES_EVERY].swapaxes(0, 1)])
    return np.stack([lines[:, :-1], lines[:, 1:]], axis=2).reshape(-1, 2, 3)


def make_finger_mesh(radius_m: float) -> tuple[Floats, NDArray[np.int32]]:
    """Return the mesh of a fingertip whose tip is at the origin.

    The mesh has n vertices (n, 3), m, and t triangles (t, 3).
    """
    tilt = np.linspace(0.0, 0.5 * np.pi, 8)
    radii = np.concatenate([radius_m * np.sin(tilt), [1.15 * radius_m, 0.0]])
    ends = [FINGER_LENGTH_M, FINGER_LENGTH_M + 0.4 * radius_m]
    heights = np.concatenate([radius_m * (1.0 - np.cos(tilt)), ends])
    angle = np.linspace(0.0, 2.0 * np.pi, 20, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(20)], axis=1)
    points = (radii[:, None, None] * circle).reshape(-1, 3)
    points[:, 2] = np.repeat(heights, 20)
    # Tilt the finger about the centre of its tip, because a real finger comes from below.
    centre = np.array([0.0, 0.0, radius_m])
    lean = rotation_from_vector([FINGER_TILT_RAD, 0.0, 0.0])
    return make_hull((points - centre) @ lean.T + centre)


def _set_pose(handle: Any, pose: Floats) -> None:
    handle.position = pose[:3, 3]
    handle.wxyz = quaternion_from_rotation(pose[:3, :3])


def _f32(values: Floats) -> NDArray[np.float32]:
    return np.ascontiguousarray(values, dtype=np.float32)
