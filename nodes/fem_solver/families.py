"""The soft body's methods for `flexsheet chart soft-body`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import structlog
from numpy.typing import NDArray

from messages.scene import Cylinder, Scene, cylinder_of
from nodes.fem_solver.body import spec_of
from nodes.fem_solver.cache import default_cache_dir
from nodes.fem_solver.contact import LinearSoftBody, Response
from nodes.fem_solver.place import Push
from nodes.fem_solver.precompute import Budget, SoftBodyModel, SoftBodySpec, load_or_compute
from nodes.methods import Family, Trial
from nodes.models.shapes import make_shape

Floats = NDArray[np.float64]

SPACINGS_M = {"linear, coarse": 0.006, "linear, medium": 0.0045, "linear, fine": 0.003}
REFERENCE_SPACING_M = 0.0022
REFERENCE_TOUCH_RAD = 0.7
"""The reference is loaded near the charted place only."""
DEPTHS_M = (0.001, 0.002, 0.003, 0.004, 0.005, 0.006, 0.008, 0.010)
PLACE_M = (0.004, 0.003)
"""Along the axis and around the side: no node of any mesh, so that no method is favoured."""
LINEAR_DEPTH_M, LARGEST_DEPTH_M = 0.006, 0.010
RIM_RATIO = 1.5
"""Errors count outside this many finger radii, where the picture shows the skin."""


def soft_body_trials(
    scene: Scene,
    *,
    spacings_m: Mapping[str, float],
    reference_spacing_m: float,
    cache_dir: Path,
) -> Iterator[Trial]:
    """Each mesh at each depth, judged by the largest error (mm) of a skin node off the finger."""
    spec, cylinder = spec_of(scene, reference_spacing_m), cylinder_of(scene)
    touch_rad = min(REFERENCE_TOUCH_RAD, spec.mesh.touch_angle_rad)
    reference_spec = replace(spec, mesh=replace(spec.mesh, touch_angle_rad=touch_rad))
    reference_model = _model(reference_spec, cache_dir)
    # past its range the linear model is charted as it is, without the saturation of the screen
    reference = _method(reference_model, scene, 2 * LARGEST_DEPTH_M)
    for name, spacing in spacings_m.items():
        model = _model(spec_of(scene, spacing), cache_dir)
        method = _method(model, scene, 2 * LARGEST_DEPTH_M)
        for depth in DEPTHS_M:
            push = _push(cylinder, depth)
            wanted = reference.respond(push)
            yield Trial(
                method=name,
                case={"depth_mm": 1e3 * depth},
                size={"skin_nodes": len(model.response.rest)},
                run=partial(method.respond, push),
                error=partial(
                    _error_mm,
                    model=model,
                    wanted=_interpolated(reference_model, wanted, model.response.rest, cylinder),
                    centre=push.surface,
                    rim_m=RIM_RATIO * scene.finger.radius_m,
                ),
                in_range=depth <= LINEAR_DEPTH_M,
            )


def _model(spec: SoftBodySpec, cache_dir: Path) -> SoftBodyModel:
    def say(done: int, total: int, need: Budget) -> None:
        if done == 0:
            structlog.get_logger().info(
                "precomputing a soft body", spacing_m=spec.mesh.skin_spacing_m, need=need.text()
            )

    return load_or_compute(spec, cache_dir, say)


def _method(model: SoftBodyModel, scene: Scene, linear_depth_m: float) -> LinearSoftBody:
    return LinearSoftBody(
        model.response,
        make_shape(dict(scene.object.geometry)),
        model.response.rest[model.bounds],
        young_modulus_pa=scene.object.material.young_modulus_pa,
        finger_radius_m=scene.finger.radius_m,
        linear_depth_m=linear_depth_m,
        largest_depth_m=2 * linear_depth_m,
    )


def _push(cylinder: Cylinder, depth_m: float) -> Push:
    angle = PLACE_M[1] / cylinder.radius_m
    normal = np.array([0.0, np.sin(angle), np.cos(angle)])
    return Push(cylinder.radius_m * normal + np.array([PLACE_M[0], 0.0, 0.0]), normal, depth_m)


def _unrolled(points: Floats, radius_m: float) -> Floats:
    """Side of the cylinder laid flat: along the axis, around (n, 2), m."""
    return np.column_stack([points[:, 0], radius_m * np.arctan2(points[:, 1], points[:, 2])])


def _interpolated(
    model: SoftBodyModel, response: Response, points: Floats, cylinder: Cylinder
) -> Floats:
    """A response at other skin points (n, 3); NaN where these are not on the front of the side."""
    from scipy.interpolate import CloughTocher2DInterpolator

    def on_front(rest: Floats) -> NDArray[np.bool_]:
        side = np.hypot(rest[:, 1], rest[:, 2]) > (1.0 - 1e-9) * cylinder.radius_m
        return side & (rest[:, 2] > -0.5 * cylinder.radius_m)

    known = on_front(model.response.rest)
    field = CloughTocher2DInterpolator(
        _unrolled(model.response.rest[known], cylinder.radius_m), response.displacement[known]
    )
    result = np.full(points.shape, np.nan)
    asked = on_front(points)
    result[asked] = field(_unrolled(points[asked], cylinder.radius_m))
    return result


def _error_mm(
    response: Response, *, model: SoftBodyModel, wanted: Floats, centre: Floats, rim_m: float
) -> float:
    away = np.linalg.norm(model.response.rest - centre, axis=1) > rim_m
    difference = np.linalg.norm(response.displacement - wanted, axis=1)[away]
    return 1e3 * float(np.nanmax(difference))


SOFT_BODY = Family(
    name="soft-body",
    unit="mm",
    reference=(
        f"the same linear body with {1e3 * REFERENCE_SPACING_M:g} mm between skin nodes: what the "
        "mesh costs; what linearity costs is not in these errors, so deeper than "
        f"{1e3 * LINEAR_DEPTH_M:g} mm they say nothing about truth"
    ),
    methods=tuple(SPACINGS_M),
    trials=lambda scene: soft_body_trials(
        scene,
        spacings_m=SPACINGS_M,
        reference_spacing_m=REFERENCE_SPACING_M,
        cache_dir=default_cache_dir(),
    ),
    tolerance=lambda scene: 1e3 * scene.tolerances.skin_m,
)
