"""Compute the points of the simulated sheet that the projected check marks illuminate.

Check marks are white squares by which the calibrations are checked. The simulated stereo camera
sees the illuminated points. "True" refers to the simulated hardware.
"""

from __future__ import annotations

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.scene import Scene, require_projector
from flexsheet.messages.types import Frame, TwinArms
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.background import leave_real_time
from flexsheet.nodes.models.rigid import apply, inverse, pose_matrix, transform
from flexsheet.nodes.twin.eye import TrueProjector
from flexsheet.nodes.twin.membrane import NotConvergedError, make_edge_plane
from flexsheet.nodes.twin.projector import on_plane
from flexsheet.nodes.twin.rig import slopes_of
from flexsheet.nodes.twin.sheet_pull import find_clamps, solve_sheet
from flexsheet.nodes.twin.truth import find_display_delay_s

CELLS = 8
"""The number of intervals between nodes along each side of the sheet. Solving takes 0.15 s."""

SOLVE_PERIOD_NS = 500_000_000
"""The minimum time (ns) between two solutions of the sheet's shape."""

MAX_FINGER_MOTION_M = 5e-4
"""The maximum motion (m) of a pushing finger since the last solution of the sheet's shape. After a
larger motion, the shape is unknown, and no marks are drawn."""


@dataclass(frozen=True, slots=True)
class _Heights:
    """The heights of the sheet at the projected marks, above the plane of its edges.

    heights_m (n,): heights at the marks.
    finger_sheet_m (3,): position of the fingertip in the frame of this plane.
    pushed: whether the finger deforms the sheet.
    """

    heights_m: Floats
    finger_sheet_m: Floats
    pushed: bool


class LitMarks:
    """A model of the sheet that computes the points that the projected marks illuminate.

    The sheet moves with the simulated arms. A background thread computes the deflection of the
    sheet by the finger and by gravity.
    """

    def __init__(self, scene: Scene, apparatus: Apparatus | None) -> None:
        """Store the parameters of the simulated devices.

        scene: scene with the true parameters of the devices.
        apparatus: deviations of the devices from the scene that the nodes assume.
        """
        self._scene, self._apparatus = scene, apparatus
        self._world_from_projector = pose_matrix(require_projector(scene).world_from_projector)
        self._frames: deque[tuple[int, Floats]] = deque(maxlen=16)
        self._worker = ThreadPoolExecutor(1, "sheet", leave_real_time)
        self._solving: Future[_Heights | None] | None = None
        self._solved_ns = 0
        self._heights: _Heights | None = None

    def close(self) -> None:
        self._worker.shutdown(cancel_futures=True)

    def settle(self) -> None:
        """Wait until a running computation of the sheet's shape is finished."""
        if self._solving is not None:
            self._solving.exception()

    def on_frame(self, frame: Frame) -> None:
        """Store the projected check marks of a frame.

        The simulated projector shows them until the next frame is displayed.
        """
        if frame.light_ns and len(frame.marks_px):
            late_ns = round(1e9 * find_display_delay_s(frame, self._apparatus))
            self._frames.append((frame.light_ns + late_ns, frame.marks_px))

    def light(self, arms: TwinArms, finger: Floats, at_ns: int) -> Floats:
        """Return the points (n, 3) of the sheet that projected check marks illuminate.

        finger (3,): position of the fingertip at the time `at_ns`, m, which deforms the sheet.

        The points are in the world frame, m. The result is empty if no marks are displayed. It is
        also empty if the finger has moved too far since the sheet's shape was computed.
        """
        shown = [pixels for light_ns, pixels in self._frames if light_ns <= at_ns]
        if not shown:
            return np.zeros((0, 3))
        edges = self._edges(arms)
        plane = make_edge_plane(*edges)
        local = apply(inverse(plane), finger)
        self._solve_if_due(edges, plane, finger, shown[-1], at_ns)
        heights = self._heights
        if heights is None or len(heights.heights_m) != len(shown[-1]):
            return np.zeros((0, 3))
        moved_m = float(np.linalg.norm(local - heights.finger_sheet_m))
        if (heights.pushed or local[2] < 0.0) and moved_m > MAX_FINGER_MOTION_M:
            return np.zeros((0, 3))
        origin, rays = self._rays(shown[-1])
        points = []
        for ray, height_m in zip(rays, heights.heights_m.tolist(), strict=True):
            raised = plane @ transform(np.eye(3), [0.0, 0.0, height_m])
            points.append(on_plane(origin, ray, raised)[0])
        return np.stack(points)

    def _edges(self, arms: TwinArms) -> tuple[Floats, Floats]:
        left, right = find_clamps(self._scene)
        return arms.world_from_flange_left @ left, arms.world_from_flange_right @ right

    def _rays(self, pixels: Floats) -> tuple[Floats, Floats]:
        slopes = slopes_of(require_projector(self._scene).lens, pixels)
        pose = self._world_from_projector
        return pose[:3, 3], np.column_stack([slopes, np.ones(len(slopes))]) @ pose[:3, :3].T

    def _solve_if_due(
        self,
        edges: tuple[Floats, Floats],
        plane: Floats,
        finger: Floats,
        pixels: Floats,
        at_ns: int,
    ) -> None:
        if self._solving is not None and self._solving.done():
            self._heights, self._solving = self._solving.result(), None
        if self._solving is None and at_ns - self._solved_ns >= SOLVE_PERIOD_NS:
            self._solved_ns = at_ns
            self._solving = self._worker.submit(self._solve, edges, plane, finger, pixels)

    def _solve(
        self, edges: tuple[Floats, Floats], plane: Floats, finger: Floats, pixels: Floats
    ) -> _Heights | None:
        scene = self._scene
        try:
            sheet = solve_sheet(scene, self._apparatus, edges, finger, cells=CELLS)
        except NotConvergedError:
            return None
        vertices = sheet.positions.reshape(-1, 3)
        true = TrueProjector(require_projector(scene), vertices, sheet.triangles())
        points, lands = true.intersect_surface(pixels)
        heights = np.where(lands, apply(inverse(plane), points)[:, 2], 0.0)
        local = apply(inverse(plane), finger)
        return _Heights(heights, local, bool(np.any(sheet.finger_force_n)))
