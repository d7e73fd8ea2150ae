"""Provide models of the rubber sheet: the poses of the sheet's edges, the shape and the forces.

The sheet frame has its origin at the centre. The x axis points from the left to the right clamped
edge, y points along the edges, and z points towards the user. The functions convert between the
poses of the sheet, of its edges and of the arms' flanges.
"""

from __future__ import annotations

import numpy as np

from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import inverse, transform


def edge_poses(world_from_sheet: Floats, edge_distance_m: float) -> tuple[Floats, Floats]:
    """Return the pose world_from_edge (4, 4) of the left and of the right edge of a flat sheet."""
    offset = 0.5 * edge_distance_m * world_from_sheet[:3, 0]
    rotation, centre = world_from_sheet[:3, :3], world_from_sheet[:3, 3]
    return transform(rotation, centre - offset), transform(rotation, centre + offset)


def sheet_from_edges(world_from_left_edge: Floats, world_from_right_edge: Floats) -> Floats:
    """Return the pose world_from_sheet (4, 4) of the sheet between two edges.

    The edges need not be parallel. The sheet's origin is midway between the edges, and x points
    from the left to the right edge. The y axis is the mean of the edges' y axes, made perpendicular
    to x. The result is not finite if the edges coincide.
    """
    left, right = world_from_left_edge, world_from_right_edge
    x_axis = right[:3, 3] - left[:3, 3]
    x_axis = x_axis / np.linalg.norm(x_axis)
    y_axis = left[:3, 1] + right[:3, 1]
    y_axis = y_axis - x_axis * (x_axis @ y_axis)
    y_axis = y_axis / np.linalg.norm(y_axis)
    rotation = np.column_stack([x_axis, y_axis, np.cross(x_axis, y_axis)])
    return transform(rotation, 0.5 * (left[:3, 3] + right[:3, 3]))


def corners(world_from_left_edge: Floats, world_from_right_edge: Floats, height_m: float) -> Floats:
    """Return the sheet's corners (4, 3), m, in the world frame.

    The order is bottom left, bottom right, top right, top left.

    height_m: length of an edge.
    """
    half = 0.5 * height_m
    left, right = world_from_left_edge, world_from_right_edge
    return np.array(
        [
            left[:3, 3] - half * left[:3, 1],
            right[:3, 3] - half * right[:3, 1],
            right[:3, 3] + half * right[:3, 1],
            left[:3, 3] + half * left[:3, 1],
        ]
    )


def flange_pose(world_from_edge: Floats, flange_from_edge: Floats) -> Floats:
    """Return the pose world_from_flange (4, 4) of the flange that holds a clamped edge.

    flange_from_edge (4, 4): pose of the edge in the frame of the flange.
    """
    return world_from_edge @ inverse(flange_from_edge)
