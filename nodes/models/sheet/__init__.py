"""Provide models of the rubber sheet: poses of its edges, shape and forces.

The sheet frame has its origin at the centre. The x axis points from the left to the right clamped
edge, y points along the edges, and z points towards the user.
"""

from __future__ import annotations

from flexsheet.nodes.models.sheet.geometry import corners, edge_poses, flange_pose, sheet_from_edges
from flexsheet.nodes.models.sheet.tension import (
    edge_force_for_stiffness,
    edge_force_n,
    push_stiffness_n_per_m,
    stretch_for_edge_force,
)

__all__ = [
    "corners",
    "edge_force_for_stiffness",
    "edge_force_n",
    "edge_poses",
    "flange_pose",
    "push_stiffness_n_per_m",
    "sheet_from_edges",
    "stretch_for_edge_force",
]
