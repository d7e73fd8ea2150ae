"""Define the interface of an arm's kinematics, which bridge, limiter and checks of the reach use.

Joints are (6,) in radians, poses 4x4 `base_from_flange` in metres.  `closed_form` and `joint_chain`
implement the interface, and `geometry.make_kinematics` selects one by the arm's model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.scene import ArmModel

Floats = NDArray[np.float64]


class UnreachableError(FlexsheetError, ValueError):
    """A flange pose for which no joint solution is within the joint ranges.

    limit: "reach", "singularity", or the joint ("J1" to "J6") that is out of range in the nearest
        solution.
    """

    code = "unreachable"
    remedy = "`flexsheet doctor scene SCENE` lists what is out of reach and what would help."

    def __init__(self, text: str, limit: str) -> None:
        super().__init__(text)
        self.limit = limit


class ArmKinematics(Protocol):
    """Kinematics of one arm.  A branch is one of the discrete joint solutions of a pose."""

    @property
    def model(self) -> ArmModel:
        """Return the dimensions and limits of the arm."""
        ...

    def forward(self, joints_rad: Floats) -> Floats:
        """Return the flange's pose base_from_flange (4, 4) at joints (6,) rad."""
        ...

    def jacobian(self, joints_rad: Floats) -> Floats:
        """Return d(velocity, angular velocity of the flange) / d(joint speeds), base frame.

        joints_rad: (n, 6); the result is (n, 6, 6).
        """
        ...

    def solve_next_joints(self, base_from_flange: Floats, present_rad: Floats) -> Floats:
        """Return joints (6,) rad near the present ones, within their ranges.

        The work is bounded, since a bridge calls this in each cycle.  Raises UnreachableError.
        """
        ...

    def solve_all(self, base_from_flange: Floats) -> Sequence[Floats]:
        """Return the joints (6,) rad on all branches, in or out of the joint ranges."""
        ...

    def find_branch(self, joints_rad: Floats) -> Any:
        """Return the branch of joints (6,) rad, a named tuple."""
        ...

    def list_branches(self, base_from_flange: Floats) -> Sequence[Any]:
        """Return the branches on which the arm may reach poses (n, 4, 4)."""
        ...

    def solve_joints_on_branch(
        self, base_from_flange: Floats, branch: Any, near_rad: Floats
    ) -> Floats:
        """Return joints (n, 6) rad for poses (n, 4, 4) on one branch; NaN where out of reach."""
        ...

    def reach_margins_m(self, base_from_flange: Floats) -> Floats:
        """Return how far (n,) poses (n, 4, 4) are within the arm's largest distance."""
        ...

    def singularity_margins(self, joints_rad: Floats) -> Mapping[str, Floats]:
        """Return by limit the distances (n,) of joints (n, 6) from being too near a singularity."""
        ...


class SeedBranch(NamedTuple):
    """Branch of an arm without closed form: the solutions that continue from some joints."""

    seed_rad: tuple[float, ...]
