"""Define the interface of an arm's kinematics.

Joint angles are (6,) in radians, poses are 4x4 `base_from_flange` in metres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.scene import ArmModel
from flexsheet.nodes.arrays import Floats


class UnreachableError(FlexsheetError, ValueError):
    """An error for a flange pose that no permitted joint angles reach.

    limit: "reach", "singularity", or the joint ("J1" to "J6") that is out of range in the nearest
        solution.
    """

    code = "unreachable"
    remedy = "Run `flexsheet doctor scene SCENE`, which lists the limits and possible changes."

    def __init__(self, text: str, limit: str) -> None:
        super().__init__(text)
        self.limit = limit


class ArmKinematics(Protocol):
    """The interface of the kinematics of one arm.

    A branch is one of the discrete joint solutions of a pose.
    """

    @property
    def model(self) -> ArmModel:
        """Return the dimensions and limits of the arm."""
        ...

    def forward(self, joints_rad: Floats) -> Floats:
        """Return the flange pose base_from_flange (4, 4) at joint angles (6,) rad."""
        ...

    def jacobian(self, joints_rad: Floats) -> Floats:
        """Return the Jacobian (n, 6, 6) in the base frame at joint angles (n, 6) rad.

        The Jacobian maps joint speeds to the linear and then the angular velocity of the flange.
        """
        ...

    def solve_next_joints(self, base_from_flange: Floats, present_rad: Floats) -> Floats:
        """Return the joint angles (6,) rad for a flange pose (4, 4) near the present angles (6,).

        The computing time is bounded, because this method is called in each control cycle. Raises
        UnreachableError if the arm cannot reach the pose.
        """
        ...

    def solve_all(self, base_from_flange: Floats) -> Sequence[Floats]:
        """Return the joint angles (6,) rad of all solutions for a flange pose (4, 4)."""
        ...

    def find_branch(self, joints_rad: Floats) -> Any:
        """Return the branch (a named tuple) to which joint angles (6,) rad belong."""
        ...

    def list_branches(self, base_from_flange: Floats) -> Sequence[Any]:
        """Return the branches on which the arm may be able to reach flange poses (n, 4, 4)."""
        ...

    def solve_joints_on_branch(
        self, base_from_flange: Floats, branch: Any, near_rad: Floats
    ) -> Floats:
        """Return the joint angles (n, 6) rad for flange poses (n, 4, 4) on one branch.

        near_rad: joint angles (6,) near the result. The angles are NaN for poses that are out of
            reach.
        """
        ...

    def reach_margins_m(self, base_from_flange: Floats) -> Floats:
        """Return the distances (n,), m, of flange poses (n, 4, 4) from the arm's maximum reach.

        A distance is positive if the pose is within reach.
        """
        ...

    def singularity_margins(self, joints_rad: Floats) -> Mapping[str, Floats]:
        """Return the margins (n,) of joint angles (n, 6) rad with respect to each singularity.

        The result has one array for each kind of singularity. A margin is the distance from the
        singularity minus the minimum distance. It is negative if the arm is too near to the
        singularity.
        """
        ...


class SeedBranch(NamedTuple):
    """A branch of an arm without closed-form kinematics, defined by one joint solution (6,) rad."""

    seed_rad: tuple[float, ...]
