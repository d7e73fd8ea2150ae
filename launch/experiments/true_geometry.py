"""Compute the true poses of the sheet's edges for the poses that the nodes command.

Kinematics are those of the simulated arms, which share no code with the nodes' kinematics.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.scene import ArmSpec, Pose, Scene
from flexsheet.nodes.models.rigid import inverse, transform, transform_from_rpy
from flexsheet.nodes.twin.arms import forward, solve_inverse_kinematics
from flexsheet.nodes.twin.arms_node import START_GUESS_RAD
from flexsheet.nodes.twin.sheet_pull import SheetPull
from flexsheet.nodes.twin.truth import apply_apparatus

Floats = NDArray[np.float64]


def pose_matrix(pose: Pose) -> Floats:
    """Return a pose as a homogeneous matrix (4, 4)."""
    return transform_from_rpy(pose.position_m, pose.rpy_rad)


def place_edges(world_from_sheet: Floats, distance_m: float) -> tuple[Floats, Floats]:
    """Return world_from_edge (4, 4) of the left and the right edge of a flat sheet.

    distance_m: distance between the edges.
    """
    rotation, centre = world_from_sheet[:3, :3], world_from_sheet[:3, 3]
    half = 0.5 * distance_m * rotation[:, 0]
    return transform(rotation, centre - half), transform(rotation, centre + half)


@dataclass(frozen=True, slots=True)
class ArmModel:
    """Geometry of one arm: pose of its base, and pose of the clamped edge on its flange, (4, 4)."""

    world_from_base: Floats
    flange_from_edge: Floats

    @classmethod
    def of(cls, arm: ArmSpec) -> Self:
        return cls(pose_matrix(arm.world_from_base), pose_matrix(arm.flange_from_edge))

    def solve_joints(self, world_from_edge: Floats, guess_rad: Floats) -> Floats:
        """Return the joint angles (6,), rad, for a pose of the edge; ValueError if out of reach."""
        flange = inverse(self.world_from_base) @ world_from_edge @ inverse(self.flange_from_edge)
        return solve_inverse_kinematics(flange, guess_rad)


class ArmPair:
    """Both arms, with the geometry that the scene assumes and their true geometry."""

    def __init__(self, scene: Scene, apparatus: Apparatus) -> None:
        true_scene = apply_apparatus(scene, apparatus)
        specs, true_specs = scene.arms, true_scene.arms
        self._believed = ArmModel.of(specs.left), ArmModel.of(specs.right)
        self._true = ArmModel.of(true_specs.left), ArmModel.of(true_specs.right)
        self._offsets_rad = (
            np.array(apparatus.arms.left.joint_offsets_rad),
            np.array(apparatus.arms.right.joint_offsets_rad),
        )
        self._pull = SheetPull.of(true_scene.sheet, apparatus)
        self._guesses = [START_GUESS_RAD, START_GUESS_RAD]

    def solve_joints(self, edges: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
        """Return the joint angles (6,) of both arms, rad, for commanded poses `edges` (4, 4)."""
        for side, edge in enumerate(edges):
            self._guesses[side] = self._believed[side].solve_joints(edge, self._guesses[side])
        return self._guesses[0], self._guesses[1]

    def hold(self, edges: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
        """Return the true poses (4, 4) of the edges at rest, for commanded poses `edges` (4, 4).

        The pull of the sheet displaces the flanges. Backlash and servo lag are not included.
        """
        left, right = (
            arm.world_from_base @ forward(joints_rad + offsets_rad)
            for arm, joints_rad, offsets_rad in zip(
                self._true, self.solve_joints(edges), self._offsets_rad, strict=True
            )
        )
        clamps = [arm.flange_from_edge for arm in self._true]
        if self._pull is not None:
            left, right = self._pull.displace(left, right, clamps[0], clamps[1])
        return left @ clamps[0], right @ clamps[1]
