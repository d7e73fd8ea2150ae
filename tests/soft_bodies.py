"""Provide specifications of soft bodies, and an executor without processes, for tests."""

from __future__ import annotations

from concurrent.futures import Executor, Future
from typing import Any

import numpy as np

from flexsheet.messages.scene import Cylinder, StripSupport
from flexsheet.nodes.fem_solver.contact import SkinResponse
from flexsheet.nodes.fem_solver.mesh.from_scene import MeshSpec
from flexsheet.nodes.fem_solver.precompute import SoftBodySpec
from flexsheet.nodes.fem_solver.table import Table


def cylinder_spec(
    radius_m: float,
    length_m: float,
    *,
    touch_angle_rad: float,
    skin_spacing_m: float,
    support_angle_rad: float = 0.5 * np.pi,
    poisson_ratio: float = 0.45,
) -> SoftBodySpec:
    """Return a horizontal cylinder that is fixed at its back."""
    mesh = MeshSpec(
        geometry=Cylinder(radius_m=radius_m, length_m=length_m),
        support=StripSupport(angle_rad=support_angle_rad),
        touch_angle_rad=touch_angle_rad,
        skin_spacing_m=skin_spacing_m,
        towards_user=(0.0, 0.0, 1.0),
        down=(0.0, 0.0, 0.0),
        rotation_rad=0.0,
        slab_depth_m=0.0,
    )
    return SoftBodySpec(mesh, poisson_ratio)


def make_even_table(response: SkinResponse, newtons_per_metre: float) -> Table:
    """Return a table to 20 mm in which each push has the same stiffness and moves no skin."""
    depths, count = np.linspace(0.0, 0.02, 6), len(response.contact_nodes)
    fields = np.zeros((count, 5, response.rest.size), dtype=np.float32)
    force_n = newtons_per_metre * depths[:, None] * response.normals[:, None]
    return Table(depths, fields, force_n, np.full(count, 0.02))


class InlineExecutor(Executor):
    """Run submitted functions at once, in this process."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future
