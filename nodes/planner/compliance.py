"""Choose the sheet's stretch and normal offset, so that it renders the object's force.

Two arms hold a stretched sheet where the surface of a virtual object is.  A finger at depth `d` in
the object would indent a sheet that stays in the object's tangent plane by `d`.  Such a sheet would
have the object's force at one depth only.  So the sheet also moves along its normal: by an offset
r(d) behind the tangent plane (in front of it where r is negative).  The sheet's force then equals
the object's, at the indentation d - r:

    F_sheet(stretch, d - r(d)) = F_object(d).

A retreat is an offset that grows with the depth: the sheet moves away from the finger.  Since the
sheet lags behind, a retreat removes energy from slow pushes and so damps them.  An advance (r falls
with d) adds energy.  `nodes.models.hand_loop` gives the largest slopes dr/dd at which every hand
is stable with the measured delay.  The chosen stretch is the lowest one that renders the curve
without an advance, or else the one with the smallest advance.

Below the threshold of touch the sheet does not advance.  Otherwise it would respond to the noise of
the camera while a finger only strokes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import scipy

from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.scene import Scene, SheetSpec
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.hand_loop import OffsetBounds
from flexsheet.nodes.models.interpolation import smoothstep
from flexsheet.nodes.models.sheet import (
    edge_force_for_stiffness,
    edge_force_n,
    push_stiffness_n_per_m,
    stretch_for_edge_force,
)
from flexsheet.nodes.models.sheet.force_models import (
    CENTRE,
    SheetForceModel,
    SheetPosition,
    SheetPush,
    depth_for_force,
    interpolate_inverse,
)

USABLE_FRACTION = 0.85
"""Fraction of the maximum edge force and strain that the planner uses.

The bridges stop the arms where commanded or measured poses reach the limits.  Two moving arms are
never exactly as far apart as planned, since each receives the other's state a cycle or two late.
"""

FORCE_JND_FLOOR_N = 0.05
"""Minimum force by which a force error is divided to make it relative.  Smaller forces, as in the
first 2 mm of an object of 4 kPa, have relative errors of at least a tenth."""

DEADBAND_START_N, DEADBAND_END_N = 0.25 * FORCE_JND_FLOOR_N, FORCE_JND_FLOOR_N
"""Contact forces up to which the sheet does not advance, and from which it advances fully.  The
contact force is the larger one of object and sheet."""

DEADBAND_START_M, DEADBAND_END_M = 0.3e-3, 1.2e-3
"""Depths up to which the sheet does not advance, and from which it advances fully.  A smaller depth
may be a fingertip that only rests on the object."""

TARGET_ERROR_RATIO = 0.10
"""Relative error of the rendered force above which a note reports it."""

WEBER_RATIO, WEBER_RATIO_BARE = 0.15, 0.22
"""Minimum relative difference of stiffness that users notice.  0.15: if the deformation of the skin
is a cue (Bergmann Tiest & Kappers 2009).  0.22: if neither work nor terminal force is a cue (Tan et
al. 1995)."""

MAX_ADVANCE_PER_DEPTH = 0.5
"""Maximum advance of the sheet per depth of the push; 0.5 feels 1.5 times as stiff as the sheet.

The bounds for a stable loop with the hand are usually lower.
"""

SLOPE_TOLERANCE = 0.03
"""Amount by which a slope may exceed its bound, since the bounds contain larger margins."""

STRETCH_CANDIDATES = 17
"""Number of stretch ratios that are tried from minimum to maximum."""


class UnfitCurveError(FlexsheetError, ValueError):
    """A force curve that is not finite, not ascending, or too short."""

    code = "force-curve"
    remedy = "Give force over depth from zero, rising, without repeated depths."


@dataclass(frozen=True, slots=True)
class ObjectCurve:
    """Force of the object against depth: n ascending points from (0, 0).

    Between the points the curve is a monotone cubic, beyond the last a line with the last slope.
    """

    depths_m: Floats
    forces_n: Floats
    _curve: scipy.interpolate.PchipInterpolator = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Raise UnfitCurveError unless there are two or more finite, ascending points."""
        depths, forces = self.depths_m, self.forces_n
        if depths.ndim != 1 or len(depths) < 2 or depths.shape != forces.shape:
            raise UnfitCurveError(
                f"force curve: {depths.shape} depths and {forces.shape} forces; give as many "
                "forces as depths, two or more"
            )
        if not (np.isfinite(depths).all() and np.isfinite(forces).all()):
            raise UnfitCurveError("force curve: a depth or force is not finite")
        if depths[0] != 0.0 or forces[0] != 0.0:
            raise UnfitCurveError(
                f"force curve: the first row is {depths[0]:g} m, {forces[0]:g} N; it must be 0, 0"
            )
        if (np.diff(depths) <= 0.0).any() or (np.diff(forces) < 0.0).any():
            raise UnfitCurveError("force curve: depths must ascend and forces must not fall")
        object.__setattr__(self, "_curve", scipy.interpolate.PchipInterpolator(depths, forces))

    @classmethod
    def from_rows(cls, rows: Floats) -> ObjectCurve:
        """Make the curve from `SoftBody.force_curve`: rows (n, 2) of depth, m, and force, N."""
        return cls(np.ascontiguousarray(rows[:, 0]), np.ascontiguousarray(rows[:, 1]))

    @classmethod
    def linear(cls, stiffness_n_per_m: float, max_depth_m: float) -> ObjectCurve:
        """Make the force curve of a linear spring up to `max_depth_m`."""
        return cls(np.array([0.0, max_depth_m]), np.array([0.0, stiffness_n_per_m * max_depth_m]))

    def force_n(self, depths_m: Floats) -> Floats:
        """Return forces (n,), N, at depths (n,), m; 0 for negative depths."""
        last = self.depths_m[-1]
        inside = self._curve(np.clip(depths_m, 0.0, last))
        beyond = np.maximum(np.asarray(depths_m) - last, 0.0)
        result: Floats = inside + beyond * float(self._curve(last, 1))
        return result


@dataclass(frozen=True, slots=True)
class StretchLimits:
    """Limits of the sheet, of the arms that stretch it, and of the control loop with the hand.

    edge_force_n: maximum force on each clamp.
    bounds: bounds on the offset's slope; None for an analysis that has no hand.
    """

    min_stretch_ratio: float
    max_stretch_ratio: float
    edge_force_n: float
    max_advance_per_depth: float = MAX_ADVANCE_PER_DEPTH
    bounds: OffsetBounds | None = None

    def max_advance(self, stiffnesses_n_per_m: Floats) -> Floats:
        """Return the maximum advance per depth (n,) where the sheet has stiffnesses (n,)."""
        result = np.full(len(stiffnesses_n_per_m), self.max_advance_per_depth)
        if self.bounds is None:
            return result
        lowest = float(self.bounds.bandwidths_rad_per_s[0])
        bounded = self.bounds.max_advance(lowest, stiffnesses_n_per_m)
        return np.asarray(np.minimum(result, bounded))


def make_stretch_limits(
    sheet: SheetSpec, model: SheetForceModel, bounds: OffsetBounds | None = None
) -> StretchLimits:
    """Return the stretch limits within the usable fraction of the scene's limits.

    They apply to the sheet if nothing pushes it.  A push adds edge force, which `render_force`
    limits.
    bounds: bounds on the offset's slope for a stable loop with the hand.
    """
    force = USABLE_FRACTION * sheet.max_edge_force_n
    least = sheet.min_stretch_ratio
    low, high = least, max(least, 1.0 + USABLE_FRACTION * (sheet.max_stretch_ratio - 1.0))
    if _flat_edge_force_n(model, high) > force:
        for _ in range(40):
            middle = 0.5 * (low + high)
            low, high = (
                (low, middle) if _flat_edge_force_n(model, middle) > force else (middle, high)
            )
        high = low
    return StretchLimits(least, high, force, bounds=bounds)


def _flat_edge_force_n(model: SheetForceModel, stretch_ratio: float) -> float:
    """Return the force (N) on each clamp of the sheet if nothing pushes it."""
    push = SheetPush(stretch_ratio, finger_radius_m=0.03 * model.rubber.width_m)
    return float(model.evaluate(push, np.zeros(1)).edge_force_n[0])


@dataclass(frozen=True, slots=True)
class RenderedForce:
    """Forces that the sheet renders at one position with one stretch, at n depths.

    indentation_m: deflection of the sheet from its plane under the finger.
    edge_force_n: force on each clamp.
    advance_per_depth: largest advance of the sheet towards the finger per depth.
    force_limited: whether the limit of the edge force reduced the indentation.
    """

    depths_m: Floats
    object_force_n: Floats
    force_n: Floats
    stiffness_n_per_m: Floats
    indentation_m: Floats
    edge_force_n: Floats
    advance_per_depth: float
    force_limited: bool

    @property
    def normal_offset_m(self) -> Floats:
        """Return the distance (n,) of the sheet behind the object's tangent plane, m."""
        return self.depths_m - self.indentation_m

    @property
    def error_ratio(self) -> Floats:
        """Return the relative error (n,) of the rendered force; 0 if neither force can be felt."""
        felt = np.maximum(self.object_force_n, self.force_n) >= FORCE_JND_FLOOR_N
        difference = (self.force_n - self.object_force_n) / np.maximum(
            self.object_force_n, FORCE_JND_FLOOR_N
        )
        result: Floats = np.where(felt, difference, 0.0)
        return result


_KNOTS = np.concatenate([np.zeros(3), np.geomspace(4e-3, 1.0, 56), np.ones(2)])
DEPTH_FRACTIONS = 0.5 * (_KNOTS[1:-2] + _KNOTS[2:-1])
"""Depths at which the offset is computed, as fractions of the maximum; denser near the surface.

They are the Greville abscissae of a quadratic B-spline on `_KNOTS`, where its control points lie.
The spline has a continuous slope, which is bounded by the slopes between its control points.  So
bounds that hold at these depths hold everywhere; an interpolating spline would not ensure that.
"""

SATURATION_FRACTION = 0.1
"""Last fraction of the maximum indentation, in which the indentation saturates smoothly."""


def render_force(
    curve: ObjectCurve,
    model: SheetForceModel,
    limits: StretchLimits,
    push: SheetPush,
    *,
    max_depth_m: float,
) -> RenderedForce:
    """Compute the best approximation of the object's force with one stretch at one position.

    The indentation never makes the edge force exceed its limit; beyond that the sheet moves with
    the finger.  The indentation grows by at most 1 + `limits.max_advance` per depth.
    """
    depths = max_depth_m * DEPTH_FRACTIONS
    desired = curve.force_n(depths)
    max_ideal_m = (1.0 + limits.max_advance_per_depth) * max_depth_m
    ideal = depth_for_force(model, push, desired, max_depth_m=max_ideal_m)
    without_offset = model.evaluate(push, depths)
    ideal = _apply_deadband(depths, ideal, np.maximum(desired, without_offset.force_n))
    max_indentation = _indentation_for_edge_force(
        model, limits.edge_force_n, push, max_depth_m=max_depth_m
    )
    saturated = _saturate(ideal, max_indentation)
    advances = limits.max_advance(model.evaluate(push, saturated).stiffness_n_per_m)
    growth = 1.0 + np.minimum(advances[1:], advances[:-1])
    max_growth = np.concatenate([[0.0], np.cumsum(growth * np.diff(depths))])
    indentation = max_growth + np.minimum.accumulate(saturated - max_growth)
    rendered = model.evaluate(push, indentation)
    slopes = np.diff(indentation) / np.diff(depths)
    return RenderedForce(
        depths_m=depths,
        object_force_n=desired,
        force_n=rendered.force_n,
        stiffness_n_per_m=rendered.stiffness_n_per_m,
        indentation_m=indentation,
        edge_force_n=rendered.edge_force_n,
        advance_per_depth=max(0.0, float(slopes.max()) - 1.0),
        force_limited=bool(ideal.max() > (1.0 - SATURATION_FRACTION) * max_indentation),
    )


def _indentation_for_edge_force(
    model: SheetForceModel, edge_force_n: float, push: SheetPush, *, max_depth_m: float
) -> float:
    """Return the indentation (m) at which the force on each clamp is `edge_force_n`.

    The result is 0 if the force is already larger without indentation.
    """
    grid = 2.0 * max_depth_m * DEPTH_FRACTIONS[1:]
    flat = _flat_edge_force_n(model, push.stretch_ratio)
    if flat >= edge_force_n:
        # `make_stretch_limits` keeps the flat sheet within the limit, apart from rounding errors.
        return 0.0 if flat > edge_force_n * (1.0 + 1e-6) else float(grid[0])
    added = model.evaluate(push, grid).edge_force_n - flat
    if added[-1] <= edge_force_n - flat:
        return float(grid[-1])
    return float(interpolate_inverse(grid, added, np.array([edge_force_n - flat]))[0])


def _apply_deadband(depths: Floats, indentation: Floats, forces_n: Floats) -> Floats:
    """Remove the advance smoothly (C1) from indentations (n,) that are too small to be felt."""
    force_weight = _fade(forces_n, DEADBAND_START_N, DEADBAND_END_N)
    depth_weight = _fade(depths, DEADBAND_START_M, DEADBAND_END_M)
    advance = np.maximum(indentation - depths, 0.0)
    return np.asarray(indentation - (1.0 - force_weight * depth_weight) * advance)


def _fade(values: Floats, start: float, end: float) -> Floats:
    return smoothstep(np.clip((values - start) / (end - start), 0.0, 1.0))


def _saturate(indentation: Floats, maximum: float) -> Floats:
    """Limit indentations (n,) to a maximum, which they approach smoothly (C1)."""
    if maximum <= 0.0:
        return np.zeros_like(indentation)
    knee, span = (1.0 - SATURATION_FRACTION) * maximum, SATURATION_FRACTION * maximum
    over = np.maximum(indentation - knee, 0.0)
    result: Floats = np.minimum(indentation, knee) - span * np.expm1(-over / span)
    return result


@dataclass(frozen=True, slots=True)
class Compliance:
    """Offset of the sheet for each depth in one object, at a constant stretch.

    note: which forces the sheet cannot render, and the error; empty if none.
    centre: rendered forces of a push at the sheet's centre.
    _nodes: |x| and |y| of the positions on the sheet at which the offset was computed, m.
    _indentation, _growth: indentation at these positions over the depth, and its derivative.
    """

    stretch_ratio: float
    note: str
    centre: RenderedForce
    model: SheetForceModel
    limits: StretchLimits
    finger_radius_m: float
    _nodes: tuple[Floats, Floats]
    _indentation: scipy.interpolate.BSpline = field(repr=False)
    _growth: scipy.interpolate.BSpline = field(repr=False)

    @property
    def max_depth_m(self) -> float:
        """Return the largest fitted depth (m), beyond which the sheet moves with the finger."""
        return float(self.centre.depths_m[-1])

    def indentation_m(self, depths_m: Floats | float, position_m: SheetPosition = CENTRE) -> Floats:
        """Return the sheet's indentation (n,), m, with the finger at depths (n,) in the object."""
        depths = np.clip(np.asarray(depths_m, dtype=np.float64), 0.0, self.max_depth_m)
        result: Floats = self._indentation(depths) @ self._weights(position_m)
        return result

    def normal_offset_m(
        self, depths_m: Floats | float, position_m: SheetPosition = CENTRE
    ) -> Floats:
        """Return the sheet's distance (n,), m, behind the object's tangent plane; < 0 in front.

        It is 0 if there is no contact, smooth (C1) over the depth and continuous over the position.
        """
        depths = np.maximum(np.asarray(depths_m, dtype=np.float64), 0.0)
        result: Floats = depths - self.indentation_m(depths, position_m)
        return result

    def offset_per_depth(self, depth_m: float, position_m: SheetPosition = CENTRE) -> float:
        """Return the change of the offset per depth: -`limits.max_advance_per_depth` to 1."""
        if depth_m <= 0.0:
            return 0.0
        if depth_m >= self.max_depth_m:
            return 1.0
        return 1.0 - float(self._growth(depth_m) @ self._weights(position_m))

    def choose_bandwidth_rad_per_s(self) -> tuple[float, bool]:
        """Choose the bandwidth (rad/s) of the depth's filter so that hands are stable.

        It is the largest that permits the offset's slopes for a push at the centre.  If none does,
        it is the smallest, and the second result is False.  Without bounds it is infinite.
        """
        bounds, push = self.limits.bounds, self.centre
        if bounds is None:
            return math.inf, True
        slopes = 1.0 - np.diff(push.indentation_m) / np.diff(push.depths_m)
        stiffnesses = np.maximum(push.stiffness_n_per_m[1:], push.stiffness_n_per_m[:-1])
        for bandwidth in bounds.bandwidths_rad_per_s[::-1].tolist():
            low = -bounds.max_advance(bandwidth, stiffnesses) - SLOPE_TOLERANCE
            high = bounds.max_retreat(bandwidth, stiffnesses) + SLOPE_TOLERANCE
            if ((low <= slopes) & (slopes <= high)).all():
                return bandwidth, True
        return float(bounds.bandwidths_rad_per_s[0]), False

    def rendered_force_n(self, depths_m: Floats, position_m: SheetPosition = CENTRE) -> Floats:
        """Return the force (n,), N, that the sheet's model predicts at depths (n,)."""
        push = SheetPush(self.stretch_ratio, self.finger_radius_m, position_m)
        return self.model.evaluate(push, self.indentation_m(depths_m, position_m)).force_n

    def _weights(self, position_m: SheetPosition) -> Floats:
        """Return weights (9,) for interpolation between the positions of `_nodes`.

        They are linear in x^2 and y^2, since the sheet is symmetric.  No weight is negative, so the
        bounds at these positions (force, advance, monotonicity) also hold between them.
        """
        weights = [
            _interpolate_squares(nodes, abs(at))
            for nodes, at in zip(self._nodes, position_m, strict=True)
        ]
        return np.outer(*weights).ravel()


def _interpolate_squares(nodes: Floats, at: float) -> Floats:
    """Return weights (n,) for interpolation, linear in the squared coordinate, between `nodes`."""
    squares, square = nodes**2, min(at, float(nodes[-1])) ** 2
    upper = int(np.clip(np.searchsorted(squares, square), 1, len(nodes) - 1))
    t = (square - squares[upper - 1]) / (squares[upper] - squares[upper - 1])
    weights = np.zeros(len(nodes))
    weights[upper - 1], weights[upper] = 1.0 - t, t
    return weights


def fit_compliance(
    curve: ObjectCurve,
    model: SheetForceModel,
    limits: StretchLimits,
    scene: Scene,
    *,
    stretch_ratio: float | None = None,
    max_depth_m: float | None = None,
) -> Compliance:
    """Find the stretch ratio and the sheet offset that best render a force curve in a scene.

    stretch_ratio: fixed stretch ratio; None: choose the best one. max_depth_m: maximum depth of a
    push; None: that of the scene. The note reports an object that is so soft that the scene's
    tolerance of the sheet's position changes its force noticeably.
    """
    depth_m = scene.working_range.push_depth_m if max_depth_m is None else max_depth_m
    radius_m, rubber = scene.finger.radius_m, model.rubber
    if stretch_ratio is None:
        stretch_ratio = _find_best_stretch(
            curve, model, limits, max_depth_m=depth_m, finger_radius_m=radius_m
        )
    half_height_m = min(scene.sheet.usable_half_height_m, 0.4 * rubber.height_m)
    xs = 0.5 * rubber.width_m * np.array([0.0, 0.3, 0.5])
    ys = half_height_m * np.array([0.0, 0.6, 1.0])
    at_nodes = [
        render_force(
            curve,
            model,
            limits,
            SheetPush(stretch_ratio, radius_m, (float(x), float(y))),
            max_depth_m=depth_m,
        )
        for x in xs
        for y in ys
    ]
    indentation = scipy.interpolate.BSpline(
        depth_m * _KNOTS, np.column_stack([one.indentation_m for one in at_nodes]), 2
    )
    return Compliance(
        stretch_ratio=stretch_ratio,
        note=_note(at_nodes[0], scene.tolerances.sheet_position_m),
        centre=at_nodes[0],
        model=model,
        limits=limits,
        finger_radius_m=radius_m,
        _nodes=(xs, ys),
        _indentation=indentation,
        _growth=indentation.derivative(),
    )


def _find_best_stretch(
    curve: ObjectCurve,
    model: SheetForceModel,
    limits: StretchLimits,
    *,
    max_depth_m: float,
    finger_radius_m: float,
) -> float:
    stretches = np.unique(
        np.linspace(limits.min_stretch_ratio, limits.max_stretch_ratio, STRETCH_CANDIDATES)
    ).tolist()
    tried = [
        render_force(
            curve, model, limits, SheetPush(stretch, finger_radius_m), max_depth_m=max_depth_m
        )
        for stretch in stretches
    ]
    max_errors = [float(np.abs(one.error_ratio).max()) for one in tried]
    allowed = max(min(max_errors) + 0.01, 0.02)
    chosen = min(
        (number for number, error in enumerate(max_errors) if error <= allowed),
        key=lambda number: (round(tried[number].advance_per_depth, 2), number),
    )
    return float(stretches[chosen])


def _note(rendered: RenderedForce, position_error_m: float) -> str:
    """Describe which forces of a push the sheet cannot render, and the error; empty if none."""
    error = rendered.error_ratio
    off = np.abs(error) > TARGET_ERROR_RATIO
    if off.any():
        # Report the largest difference in newtons, which a finger notices first.
        at = int(np.argmax(np.where(off, np.abs(rendered.force_n - rendered.object_force_n), 0.0)))
        cause = (
            "the edge force is at its limit"
            if rendered.force_limited
            else "the sheet's advance towards the finger is at its limit"
        )
        kind, than = ("stiffer", "too soft") if error[at] < 0.0 else ("softer", "too stiff")
        return (
            f"object is {kind} than the sheet can present: {100 * abs(error[at]):.0f} % {than} at "
            f"{1e3 * rendered.depths_m[at]:.0f} mm ({rendered.force_n[at]:.2f} of "
            f"{rendered.object_force_n[at]:.2f} N), {100 * np.abs(error).max():.0f} % at most; "
            f"{cause}; users notice {100 * WEBER_RATIO:.0f} to {100 * WEBER_RATIO_BARE:.0f} %"
        )
    uncertainty = compute_force_uncertainty_ratio(rendered, position_error_m)
    if uncertainty > WEBER_RATIO:
        return (
            f"object is too soft for the position tolerance: {1e3 * position_error_m:g} mm of the "
            f"sheet's position is {100 * uncertainty:.0f} % of the force at "
            f"{1e3 * rendered.depths_m[-1]:.0f} mm; users notice {100 * WEBER_RATIO:.0f} to "
            f"{100 * WEBER_RATIO_BARE:.0f} %"
        )
    return ""


def compute_force_uncertainty_ratio(rendered: RenderedForce, position_error_m: float) -> float:
    """Return the relative change of force at maximum depth that a position error causes."""
    change = float(rendered.stiffness_n_per_m[-1]) * position_error_m
    return change / max(float(rendered.object_force_n[-1]), 1e-9)


@dataclass(frozen=True, slots=True)
class StretchChoice:
    """Stretch that renders an object's stiffness; `note` reports a stiffness out of range."""

    stretch_ratio: float
    note: str


def compute_stretch_range(sheet: SheetSpec) -> tuple[float, float]:
    """Return the stretch limits of the scene, reduced to the usable edge force and strain."""
    at_max_force = stretch_for_edge_force(USABLE_FRACTION * sheet.max_edge_force_n, sheet)
    at_max_strain = 1.0 + USABLE_FRACTION * (sheet.max_stretch_ratio - 1.0)
    return sheet.min_stretch_ratio, max(sheet.min_stretch_ratio, min(at_max_strain, at_max_force))


def choose_stretch(stiffness_n_per_m: float, sheet: SheetSpec) -> StretchChoice:
    """Return the stretch that renders an object's stiffness (N/m, small pushes) without an offset.

    The linear model of the sheet ignores the object's curved force and the size of the fingertip.
    """
    least, largest = compute_stretch_range(sheet)
    desired = stretch_for_edge_force(
        edge_force_for_stiffness(stiffness_n_per_m, width_m=sheet.width_m), sheet
    )
    stretch = min(max(desired, least), largest)
    force = edge_force_n(stretch, sheet)
    rendered = push_stiffness_n_per_m(force, width_m=sheet.width_m)
    note = ""
    if desired < least:
        note = f"object of {stiffness_n_per_m:.0f} N/m is softer than the sheet, {rendered:.0f} N/m"
    elif desired > largest:
        note = (
            f"object of {stiffness_n_per_m:.0f} N/m is stiffer than the sheet, {rendered:.0f} N/m"
        )
    return StretchChoice(stretch, note)
