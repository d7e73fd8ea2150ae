"""Compute the shape of the true sheet, and how far its tension and weight displace the arms.

An apparatus contains the true parameters of the simulated hardware. A flange is the last link of an
arm.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

import numpy as np

from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.scene import Scene, SheetSpec
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import pose_matrix, transform
from flexsheet.nodes.twin import membrane
from flexsheet.nodes.twin.force_history import ForceHistory
from flexsheet.nodes.twin.membrane import GRAVITY_M_PER_S2, DeformedSheet, TrueRubber, solve

CELLS = 8
"""The number of intervals between nodes along each side of the sheet's mesh. Without a finger, the
force differs by 1 % from the force with 32 intervals."""

STRETCHES = (1.0, 1.01, 1.03, 1.06, 1.1, 1.15, 1.2, 1.3)


def true_rubber(sheet: SheetSpec, apparatus: Apparatus | None) -> TrueRubber:
    """Return the true dimensions and material of the simulated sheet."""
    gradient = (0.0, 0.0) if apparatus is None else apparatus.sheet.thickness_gradient_ratio
    return TrueRubber(
        sheet.width_m,
        sheet.height_m,
        sheet.thickness_m,
        sheet.young_modulus_pa,
        sheet.density_kg_per_m3,
        gradient,
    )


def find_clamps(scene: Scene) -> tuple[Floats, Floats]:
    """Return the poses flange_from_edge (4, 4) of the left and the right clamped edge."""
    arms = scene.arms
    return pose_matrix(arms.left.flange_from_edge), pose_matrix(arms.right.flange_from_edge)


def solve_sheet(
    true_scene: Scene,
    apparatus: Apparatus | None,
    edges: tuple[Floats, Floats],
    finger_tip: Floats | None = None,
    *,
    cells: int = membrane.CELLS,
) -> DeformedSheet:
    """Compute the equilibrium of the true sheet between its clamped edges.

    true_scene: scene with the true parameters of the devices.
    edges: poses (4, 4) of the left and the right edge.
    finger_tip: position (3,) of the fingertip, m; None if nothing pushes the sheet.
    cells: number of intervals between nodes along each side of the sheet.

    Raises NotConvergedError if the iteration does not converge.
    """
    return solve(
        true_rubber(true_scene.sheet, apparatus),
        *edges,
        finger_tip=finger_tip,
        finger_radius_m=true_scene.finger.radius_m,
        friction_coefficient=None if apparatus is None else apparatus.sheet.friction_coefficient,
        cells=cells,
    )


@dataclass(slots=True)
class SheetPull:
    """A model of the sheet's tension and weight, which displace the flanges of compliant arms.

    The force of a finger on the sheet is neglected, because it is small compared with the tension.

    distances_m, forces_n (n,): tension as a function of the distance between the clamped edges.
    compliances_m_per_n: displacements of the left and the right flange per force.
    weight_n (3,): weight of the sheet. Each flange carries half of the weight.
    history: hysteresis and creep of the tension; None if the rubber is elastic.
    """

    distances_m: Floats
    forces_n: Floats
    compliances_m_per_n: tuple[float, float]
    weight_n: Floats = field(default_factory=lambda: np.zeros(3))
    history: ForceHistory | None = None
    _rubber_ratio: float = field(default=1.0, init=False)

    @classmethod
    def of(cls, sheet: SheetSpec, apparatus: Apparatus) -> Self | None:
        """Create a model of the sheet's tension as a function of the distance between its edges.

        The tension is computed with the membrane model for several distances. Returns None if both
        arms are rigid, because the tension then does not displace the flanges.
        """
        arms = apparatus.arms
        compliances = arms.left.flange_compliance_m_per_n, arms.right.flange_compliance_m_per_n
        if not any(compliances):
            return None
        rubber = true_rubber(sheet, apparatus)
        distances_m = rubber.width_m * np.array(STRETCHES)
        forces_n = [0.0]
        for distance_m in distances_m[1:]:
            edges = [transform(np.eye(3), [0.5 * side * distance_m, 0.0, 0.0]) for side in (-1, 1)]
            forces_n.append(float(solve(rubber, *edges, cells=CELLS).left_force_n[0]))
        volume_m3 = rubber.width_m * rubber.height_m * rubber.thickness_m
        return cls(
            distances_m,
            np.array(forces_n),
            compliances,
            rubber.density_kg_per_m3 * volume_m3 * GRAVITY_M_PER_S2,
            ForceHistory.of(apparatus),
        )

    def force_n(self, distance_m: float) -> float:
        """Return the tension (N) of the sheet in equilibrium with the compliant arms.

        distance_m: distance of the sheet's edges if the arms were rigid.
        """
        forces_n = self._rubber_ratio * self.forces_n
        rigid_m = self.distances_m + sum(self.compliances_m_per_n) * forces_n
        return float(np.interp(distance_m, rigid_m, forces_n))

    def _remember(self, distance_m: float, time_s: float) -> None:
        """Add the present tension of the sheet to the history that determines hysteresis and creep.

        distance_m: distance between the clamped edges.
        """
        if self.history is None:
            return
        elastic_n = self.force_n(distance_m) / self._rubber_ratio
        if elastic_n > 0.0:
            self._rubber_ratio = self.history.update(time_s, elastic_n) / elastic_n

    def displace(
        self,
        world_from_left_flange: Floats,
        world_from_right_flange: Floats,
        left_flange_from_edge: Floats,
        right_flange_from_edge: Floats,
        *,
        time_s: float = 0.0,
    ) -> tuple[Floats, Floats]:
        """Return both flange poses (4, 4) after displacement by the sheet's tension and weight.

        The flanges are not rotated.

        time_s: time of the poses, which must not decrease between calls.
        """
        left_m = (world_from_left_flange @ left_flange_from_edge)[:3, 3]
        right_m = (world_from_right_flange @ right_flange_from_edge)[:3, 3]
        distance_m = float(np.linalg.norm(right_m - left_m))
        if distance_m <= 0.0:
            return world_from_left_flange, world_from_right_flange
        self._remember(distance_m, time_s)
        pull = self.force_n(distance_m) * (right_m - left_m) / distance_m
        left, right = world_from_left_flange.copy(), world_from_right_flange.copy()
        left[:3, 3] += self.compliances_m_per_n[0] * (0.5 * self.weight_n + pull)
        right[:3, 3] += self.compliances_m_per_n[1] * (0.5 * self.weight_n - pull)
        return left, right
