"""Draw the 3D view of the page, and update the parts that change."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import trimesh
import viser
from numpy.typing import NDArray

from flexsheet.messages.scene import ArmSpec, Scene
from flexsheet.messages.types import ArmState, Fingertip, Skin, SoftBody
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.console.arms import (
    BRACKET_WIDTH_M,
    CLAMP_SIZE_M,
    compute_link_poses,
    make_pieces,
)
from flexsheet.nodes.console.latest_messages import LatestMessages
from flexsheet.nodes.console.sheet import COLUMNS, ROWS, TRIANGLES, compute_sheet_points
from flexsheet.nodes.models.rigid import (
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
DEVICE: Color = (0, 108, 148)
EYE: Color = (196, 110, 0)
GRID: Color = (176, 181, 189)

SHEET_LIFT_M, LINES_LIFT_M = 0.0006, 0.0009
"""The distances by which the sheet and its lines are drawn nearer to the viewer. Without these
distances, a flat object in the plane of the sheet would flicker."""

LINES_EVERY = 5
FINGER_LENGTH_M = 0.05
FINGER_TILT_RAD = 0.6
NAME_ABOVE_M = np.array([0.0, 0.05, 0.0])
FLOOR_M = 0.02
"""The distance of the drawn floor below the bases of the arms."""

CAMERA_SIZE_M, PROJECTOR_SIZE_M = (0.035, 0.045), (0.16, 0.07, 0.12)
"""The size of the drawn housings. The width of the camera follows from its baseline."""

CAMERA_POSITION_M, CAMERA_TARGET_M = (0.5, 0.34, 1.3), (0.0, -0.13, 0.0)

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
        self._links: dict[str, list[Any]] = {}
        self._mesh_id: str | None = None
        self._scene.set_up_direction("+y")
        # Without a graphics card, shadows would take most of the drawing time.
        self._scene.configure_default_lights(cast_shadow=False)
        server.initial_camera.position = CAMERA_POSITION_M
        server.initial_camera.look_at = CAMERA_TARGET_M
        server.initial_camera.fov = 0.75

    def set_scene(self, scene: Scene) -> None:
        """Draw all parts of the 3D view for a new scene."""
        self._scene.reset()
        self._mesh_id = None
        arms = {"left": scene.arms.left, "right": scene.arms.right}
        lowest_m = min(arm.world_from_base.position_m[1] for arm in arms.values())
        self._scene.add_grid(
            "/floor",
            width=2.4,
            height=2.4,
            plane="xz",
            cell_size=0.1,
            section_size=0.6,
            cell_color=GRID,
            section_color=GRID,
            position=(0.0, lowest_m - FLOOR_M, 0.0),
        )
        self._links = {
            side: self._add_arm(side, arm, scene.sheet.height_m) for side, arm in arms.items()
        }
        self._add_sheet(scene)
        self._add_finger(scene.finger.radius_m)
        self._add_devices(scene)

    def set_skin(self, skin: Skin) -> None:
        """Draw the object as the surface mesh of the soft-body solver."""
        self._object = self._scene.add_mesh_simple(
            "/object",
            _f32(skin.vertices_world_m),
            skin.triangles,
            color=OBJECT,
            flat_shading=True,
        )
        highest_m = float(skin.vertices_world_m[:, 1].max())
        self._add_name("/object/name", "virtual object", (0.0, highest_m + 0.01, 0.0))
        self._mesh_id = skin.mesh_id
        self._make_touchable(self._object)

    def draw(self, scene: Scene, messages: LatestMessages) -> None:
        """Update all poses and meshes of the 3D view to the latest messages.

        scene: scene that `set_scene` has drawn.
        """
        finger = messages.latest("fingertip", Fingertip)
        body = messages.latest("soft_body", SoftBody)
        skin = messages.latest("skin", Skin)
        with self._server.atomic():
            self._draw_arms_and_sheet(scene, messages)
            if finger is not None:
                self._finger.position = finger[0].position_world_m
                self._finger.color = FINGER if finger[0].valid else FINGER_LOST
            if body and skin and body[0].mesh_id == skin[0].mesh_id == self._mesh_id:
                vertices_m = skin[0].vertices_world_m + body[0].displacement_world_m
                self._object.vertices = _f32(vertices_m)

    def _draw_arms_and_sheet(self, scene: Scene, messages: LatestMessages) -> None:
        edges = []
        for side, arm in (("left", scene.arms.left), ("right", scene.arms.right)):
            state = messages.latest(f"arm_{side}", ArmState)
            if state is None:
                return
            poses = compute_link_poses(
                pose_matrix(arm.world_from_base), state[0].joints_rad, arm.model
            )
            edges.append(state[0].world_from_flange @ pose_matrix(arm.flange_from_edge))
            for handle, pose in zip(self._links[side], (*poses, edges[-1]), strict=True):
                handle.position, handle.wxyz = _pose(pose)
                # An arm becomes visible with its first pose.
                handle.visible = True
        finger = messages.latest("fingertip", Fingertip)
        sheet = compute_sheet_points(
            *edges,
            height_m=scene.sheet.height_m,
            fingertip=finger[0].position_world_m if finger and finger[0].valid else None,
            finger_radius_m=scene.finger.radius_m,
        )
        if sheet is not None:
            self._sheet.vertices = _f32(lift_sheet(sheet, SHEET_LIFT_M))
            self._sheet_lines.points = make_line_segments(lift_sheet(sheet, LINES_LIFT_M))

    def _add_arm(self, side: str, arm: ArmSpec, height_m: float) -> list[Any]:
        """Add the links, the bracket and the clamp of an arm, and return their frames."""
        names = [*(f"/{side}/{link}" for link in range(7)), f"/{side}/clamp"]
        frames = [self._scene.add_frame(name, show_axes=False, visible=False) for name in names]
        for i, piece in enumerate(make_pieces(arm.model)):
            self._scene.add_box(
                f"/{side}/{piece.link}/{i}",
                ARM_DARK if piece.dark else ARM,
                piece.size_m,
                position=piece.centre_m,
            )
        bracket_m = np.asarray(arm.flange_from_edge.position_m)
        size_m = BRACKET_WIDTH_M + np.abs(bracket_m)
        self._scene.add_box(f"/{side}/6/bracket", ARM_DARK, size_m, position=0.5 * bracket_m)
        across, along, through = CLAMP_SIZE_M
        self._scene.add_box(f"/{side}/clamp/bar", ARM_DARK, (across, along * height_m, through))
        self._add_name(f"/names/{side}", f"{side} arm", arm.world_from_base.position_m)
        return frames

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
        self._sheet = self._scene.add_mesh_simple(
            "/sheet",
            _f32(lift_sheet(points, SHEET_LIFT_M)),
            TRIANGLES,
            color=SHEET,
            opacity=0.5,
            side="double",
            cast_shadow=False,
            receive_shadow=False,
        )
        self._sheet_lines = self._scene.add_line_segments(
            "/sheet_lines",
            make_line_segments(lift_sheet(points, LINES_LIFT_M)),
            SHEET_LINES,
            thickness=1.0,
            thickness_units="screen",
        )
        top_m = 0.5 * scene.sheet.height_m + 0.012
        self._add_name("/right/clamp/name", "rubber sheet", (0.0, top_m, 0.0))
        self._make_touchable(self._sheet)

    def _add_finger(self, radius_m: float) -> None:
        # The origin is at the tip. The finger is tilted about the centre of its tip, because a real
        # finger comes from below.
        capsule = trimesh.creation.capsule(FINGER_LENGTH_M, radius_m, count=[16, 16])
        capsule.apply_translation([0.0, 0.0, 0.5 * FINGER_LENGTH_M])
        tilt = rotation_from_vector([FINGER_TILT_RAD, 0.0, 0.0])
        capsule.apply_transform(transform(tilt, (0.0, 0.0, radius_m)))
        self._finger = self._scene.add_mesh_simple(
            "/finger",
            _f32(capsule.vertices),
            np.asarray(capsule.faces),
            color=FINGER,
            position=(0.0, 0.0, 0.08),
        )

    def _add_devices(self, scene: Scene) -> None:
        baseline_m = -float(scene.camera.right_from_left[0, 3])
        between_m = transform(np.eye(3), (0.5 * baseline_m, 0.0, 0.0))
        camera = pose_matrix(scene.camera.world_from_left) @ between_m
        devices = [("stereo camera", camera, (baseline_m + 0.05, *CAMERA_SIZE_M))]
        if scene.projector is not None:
            projector = pose_matrix(scene.projector.world_from_projector)
            devices.append(("projector", projector, PROJECTOR_SIZE_M))
        for name, pose, size_m in devices:
            # The lenses are at the front of the housing.
            centre = pose @ transform(np.eye(3), (0.0, 0.0, -0.5 * size_m[2]))
            position, wxyz = _pose(centre)
            self._scene.add_box(f"/devices/{name}", DEVICE, size_m, wxyz=wxyz, position=position)
            self._add_name(f"/names/{name}", name, position + NAME_ABOVE_M)
        half = np.array([0.5 * scene.eyes.interocular_m, 0.0, 0.0])
        for name, sign in (("left", -1.0), ("right", 1.0)):
            self._scene.add_icosphere(
                f"/devices/{name} eye",
                0.011,
                EYE,
                position=scene.eyes.centre_world_m + sign * half,
            )
        self._add_name("/names/eyes", "user's eyes", scene.eyes.centre_world_m + NAME_ABOVE_M)

    def _add_name(self, node: str, text: str, position: Any) -> None:
        self._scene.add_label(
            node,
            text,
            position=position,
            font_screen_scale=0.9,
            anchor="bottom-center",
            depth_test=False,
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


def make_line_segments(points: Floats) -> NDArray[np.float32]:
    """Return k line segments (k, 2, 3), m, along every fifth row and column of the sheet.

    points: n vertices (n, 3) of the sheet.
    """
    grid = points.reshape(ROWS, COLUMNS, 3)
    lines = np.concatenate([grid[::LINES_EVERY], grid[:, ::LINES_EVERY].swapaxes(0, 1)])
    return _f32(np.stack([lines[:, :-1], lines[:, 1:]], axis=2).reshape(-1, 2, 3))


def _pose(pose: Floats) -> tuple[Floats, Floats]:
    """Return the position (3,) and the quaternion (4,) of a pose (4, 4)."""
    return pose[:3, 3], quaternion_from_rotation(pose[:3, :3])


def _f32(values: NDArray[Any]) -> NDArray[np.float32]:
    return np.ascontiguousarray(values, dtype=np.float32)
