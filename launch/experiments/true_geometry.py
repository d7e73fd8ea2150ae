"""Compute the true poses of the sheet's edges for the poses that the nodes command.

The module uses the kinematics of the simulated arms. They share no code with the nodes' kinematics.
"""

from __future__ import annotations

import numpy as np

from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.scene import Scene
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import transform
from flexsheet.nodes.models.sheet.tension import edge_force_n
from flexsheet.nodes.twin.arms import PlacedArm
from flexsheet.nodes.twin.sheet_pull import SheetPull
from flexsheet.nodes.twin.truth import apply_apparatus


def place_edges(world_from_sheet: Floats, distance_m: float) -> tuple[Floats, Floats]:
    """Return the poses (4, 4) of the left and the right edge of a flat sheet, in the world frame.

    world_from_sheet: pose (4, 4) of the sheet. distance_m: distance between the edges.
    """
    rotation, centre = world_from_sheet[:3, :3], world_from_sheet[:3, 3]
    half = 0.5 * distance_m * rotation[:, 0]
    return transform(rotation, centre - half), transform(rotation, centre + half)


class ArmPair:
    """A pair of arms, with the geometry that the scene assumes and the true geometry."""

    def __init__(self, scene: Scene, apparatus: Apparatus) -> None:
        true_scene = apply_apparatus(scene, apparatus)
        specs, true_specs = scene.arms, true_scene.arms
        self._believed = PlacedArm.of(specs.left), PlacedArm.of(specs.right)
        self._true = PlacedArm.of(true_specs.left), PlacedArm.of(true_specs.right)
        self._specs, self._sheet = (specs.left, specs.right), scene.sheet
        self._offsets_rad = (
            np.array(apparatus.arms.left.joint_offsets_rad),
            np.array(apparatus.arms.right.joint_offsets_rad),
        )
        self._pull = SheetPull.of(true_scene.sheet, apparatus)
        self._guesses = [arm.mechanics.start_rad for arm in self._believed]

    def solve_joints(self, edges: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
        """Return the commanded joint angles (6,), in rad, of both arms.

        The angles are corrected by the scene's joint offsets and flange compliances, as in the
        nodes that control the arms.

        edges: poses (4, 4) of the sheet's edges.
        """
        across = edges[1][:3, 3] - edges[0][:3, 3]
        length_m = float(np.linalg.norm(across))
        sheet = self._sheet
        tension_n = edge_force_n(length_m / sheet.width_m, sheet)
        commanded = []
        for side, (spec, wanted) in enumerate(zip(self._specs, edges, strict=True)):
            edge, outwards = wanted.copy(), (-1.0, 1.0)[side]
            moved_m = spec.flange_compliance_m_per_n * tension_n
            edge[:3, 3] += outwards * moved_m * across / length_m
            joints_rad = self._believed[side].solve_joints(edge, self._guesses[side])
            self._guesses[side] = joints_rad
            commanded.append(joints_rad - np.array(spec.joint_offsets_rad))
        return commanded[0], commanded[1]

    def hold(
        self, edges: tuple[Floats, Floats], *, play_rad: tuple[Floats, Floats] | None = None
    ) -> tuple[Floats, Floats]:
        """Return the true poses (4, 4) of the edges at rest.

        The tension of the true sheet displaces the true flanges. Servo lag is not included.

        edges: commanded poses (4, 4).
        play_rad: position of each joint (6,) of both arms within its backlash.
        """
        commanded = self.solve_joints(edges)
        flanges = []
        for side, joints_rad in enumerate(commanded):
            true_rad = joints_rad + self._offsets_rad[side]
            if play_rad is not None:
                true_rad = true_rad + play_rad[side]
            flanges.append(self._true[side].world_from_flange(true_rad))
        left, right = flanges
        clamps = [arm.flange_from_edge for arm in self._true]
        if self._pull is not None:
            left, right = self._pull.displace(left, right, clamps[0], clamps[1])
        return left @ clamps[0], right @ clamps[1]
