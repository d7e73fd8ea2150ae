"""Choose the stretch and the normal offset of the sheet that render the force of an object.

Two arms hold a stretched sheet at the surface of a virtual object. A finger at depth d in the
object would indent a sheet in the object's tangent plane by d. The sheet's force would then equal
the object's force at one depth only. The sheet is therefore moved along its normal by an offset
r(d) behind the tangent plane:

    F_sheet(stretch, d - r(d)) = F_object(d).

The sheet retreats if the offset increases with the depth, and advances if the offset decreases. The
sheet follows the finger with a delay. A retreat therefore damps slow pushes, and an advance adds
energy. The module `hand_loop` computes the largest slopes dr/dd at which the control loop with any
hand is stable. The lowest stretch that renders the force without an advance is chosen. If every
stretch requires an advance, the stretch with the smallest advance is chosen.

The sheet does not advance at forces that are too small to be felt. Otherwise the sheet would
respond to the noise of the camera while a finger strokes the object.
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
from flexsheet.nodes.models.sheet.force_models import (
    CENTRE,
    SheetForceModel,
    SheetPosition,
    SheetPush,
    depth_for_force,
    interpolate_inverse,
)
from flexsheet.nodes.models.sheet.tension import (
    edge_force_for_stiffness,
    edge_force_n,
    push_stiffness_n_per_m,
    stretch_for_edge_force,
)

USABLE_FRACTION = 0.85
"""The fraction of the maximum edge force and of the maximum strain that the planner uses.

The margin is necessary because each arm receives the state of the other arm one or two control
cycles late."""

FORCE_JND_FLOOR_N = 0.05
"""The smallest force (N) that a user can feel. It is also the minimum divisor of relative errors.
"""

DEADBAND_START_N, DEADBAND_END_N = 0.25 * FORCE_JND_FLOOR_N, FORCE_JND_FLOOR_N
"""The contact forces (N) between which the sheet's advance increases from zero to its full value.
The contact force is the larger of two forces: the object's force and the sheet's force."""

DEADBAND_START_M, DEADBAND_END_M = 0.3e-3, 1.2e-3
"""The depths (m) between which the sheet's advance increases from zero to its full value."""

TARGET_ERROR_RATIO = 0.10
"""The relative error of the rendered force above which the planner reports the error."""

WEBER_RATIO, WEBER_RATIO_BARE = 0.15, 0.22
"""The smallest relative differences of stiffness that users notice. The first value applies if the
skin of the finger deforms (Bergmann Tiest & Kappers 2009). The second value applies if users can
compare neither work nor final force (Tan et al. 1995)."""

MAX_ADVANCE_PER_DEPTH = 0.5
"""The maximum advance of the sheet towards the finger, divided by the depth of the push. At this
value, the sheet feels 1.5 times as stiff as without an advance. The bounds that keep the control
loop with the hand stable are usually lower."""

SLOPE_TOLERANCE = 0.03
"""The tolerance by which the slope d(offset) / d(depth) may exceed its bounds. The bounds contain
larger safety margins."""

STRETCH_CANDIDATES = 17
"""The number of stretch ratios between the minimum and the maximum ratio that are tried."""


class UnfitCurveError(FlexsheetError, ValueError):
    """The error raised if a force curve is not finite, not ascending, or too short."""

    remedy = "Give forces at ascending depths, starting with force 0 N at depth 0 m."


@dataclass(frozen=True, slots=True)
class ObjectCurve:
    """The force of an object as a function of depth, given by n points that start at (0, 0).

    The curve is a monotone cubic between the points, and a line beyond the last point. Raises
    UnfitCurveError if a point is not finite, if the depths do not ascend, or if the forces fall.
    """

    depths_m: Floats
    forces_n: Floats
    _curve: scipy.interpolate.PchipInterpolator = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        depths, forces = self.depths_m, self.forces_n
        if depths.ndim != 1 or len(depths) < 2 or depths.shape != forces.shape:
            raise UnfitCurveError(
                f"force curve: the depths have the shape {depths.shape} and the forces "
                f"{forces.shape}; give two or more depths and as many forces"
            )
        if not (np.isfinite(depths).all() and np.isfinite(forces).all()):
            raise UnfitCurveError("force curve: a depth or a force is not finite")
        if depths[0] != 0.0 or forces[0] != 0.0:
            raise UnfitCurveError(
                f"force curve: the first point is {depths[0]:g} m, {forces[0]:g} N; it must be "
                "0 m, 0 N"
            )
        if (np.diff(depths) <= 0.0).any() or (np.diff(forces) < 0.0).any():
            raise UnfitCurveError(
                "force curve: the depths must ascend, and the forces must not fall"
            )
        object.__setattr__(self, "_curve", scipy.interpolate.PchipInterpolator(depths, forces))

    @classmethod
    def from_rows(cls, rows: Floats) -> ObjectCurve:
        """Make the curve from n points.

        rows: array (n, 2) with the depth (m) in column 0 and the force (N) in column 1.
        """
        return cls(np.ascontiguousarray(rows[:, 0]), np.ascontiguousarray(rows[:, 1]))

    def force_n(self, depths_m: Floats) -> Floats:
        """Return the n forces (n,), N, at the depths (n,), m; the force is 0 at negative depths."""
        last = self.depths_m[-1]
        inside = self._curve(np.clip(depths_m, 0.0, last))
        beyond = np.maximum(np.asarray(depths_m) - last, 0.0)
        result: Floats = inside + beyond * float(self._curve(last, 1))
        return result


@dataclass(frozen=True, slots=True)
class StretchLimits:
    """The limits of the sheet's stretch, edge force and normal offset.

    edge_force_n: maximum force on each clamp.
    bounds: limits of the derivative of the offset with respect to the finger's depth. Within these
        limits, the control loop with the user's hand is stable. None means that the hand is
        ignored.
    """

    min_stretch_ratio: float
    max_stretch_ratio: float
    edge_force_n: float
    bounds: OffsetBounds | None = None

    def max_advance(self, stiffnesses_n_per_m: Floats) -> Floats:
        """Return the maximum advances (n,) of the sheet towards the finger, divided by the depth.

        stiffnesses_n_per_m: n stiffnesses (n,) of the sheet.
        """
        result = np.full(len(stiffnesses_n_per_m), MAX_ADVANCE_PER_DEPTH)
        if self.bounds is None:
            return result
        lowest = float(self.bounds.bandwidths_rad_per_s[0])
        bounded = self.bounds.max_advance(lowest, stiffnesses_n_per_m)
        return np.asarray(np.minimum(result, bounded))


def make_stretch_limits(
    sheet: SheetSpec, model: SheetForceModel, bounds: OffsetBounds | None = None
) -> StretchLimits:
    """Compute the limits of stretch and edge force from the limits in the scene.

    They are a fraction USABLE_FRACTION of the scene's limits. The maximum stretch also keeps the
    edge force within its limit while nothing touches the sheet. A push increases the edge force
    further. The function `render_force` limits this increase.

    bounds: stable range of the derivative of the sheet's normal offset with respect to the finger's
        depth; None if the user's hand is ignored.
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
    """Return the force (N) on each clamp while nothing touches the sheet."""
    push = SheetPush(stretch_ratio, finger_radius_m=0.03 * model.rubber.width_m)
    return float(model.evaluate(push, np.zeros(1)).edge_force_n[0])


@dataclass(frozen=True, slots=True)
class RenderedForce:
    """The deflections and forces of the sheet at n finger depths.

    They are valid for one stretch of the sheet and one position of the push.

    depths_m: depth of the finger below the undeformed surface of the object.
    object_force_n, force_n: force of the virtual object, and force of the sheet on the finger.
    indentation_m: deflection of the sheet under the finger. It is the depth minus the sheet's
        normal offset.
    edge_force_n: force on each clamp.
    advance_per_depth: maximum advance of the sheet towards the finger, divided by the depth.
    force_limited: whether the limit of the edge force has reduced the indentation.
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
        """Return the sheet's offset (n,), m, behind the object's tangent plane at each depth."""
        return self.depths_m - self.indentation_m

    @property
    def error_ratio(self) -> Floats:
        """Return the relative errors (n,) of the rendered forces at n depths.

        The error is 0 for forces that users cannot feel.
        """
        felt = np.maximum(self.object_force_n, self.force_n) >= FORCE_JND_FLOOR_N
        difference = (self.force_n - self.object_force_n) / np.maximum(
            self.object_force_n, FORCE_JND_FLOOR_N
        )
        result: Floats = np.where(felt, difference, 0.0)
        return result


_KNOTS = np.concatenate([np.zeros(3), np.geomspace(4e-3, 1.0, 56), np.ones(2)])
DEPTH_FRACTIONS = 0.5 * (_KNOTS[1:-2] + _KNOTS[2:-1])
"""The depths at which the offset is computed, as fractions of the maximum depth.

These depths are the Greville abscissae of a quadratic B-spline with the knots `_KNOTS`. The slopes
between the control points bound the slope of the spline. Bounds that hold at these depths therefore
hold at all depths."""

SATURATION_FRACTION = 0.1
"""The fraction of the maximum indentation over which the indentation approaches its maximum
smoothly."""


def render_force(
    curve: ObjectCurve,
    model: SheetForceModel,
    limits: StretchLimits,
    push: SheetPush,
    *,
    max_depth_m: float,
) -> RenderedForce:
    """Compute the sheet's indentations at which the sheet's force is closest to the object's force.

    push: stretch ratio, finger radius and position of the push.
    max_depth_m: maximum depth of the finger in the object.

    The indentations are limited so that the force on the clamped edges does not exceed its limit.
    If the finger's depth increases by d, the indentation increases by at most (1 +
    `limits.max_advance`) * d.
    """
    depths = max_depth_m * DEPTH_FRACTIONS
    desired = curve.force_n(depths)
    max_ideal_m = (1.0 + MAX_ADVANCE_PER_DEPTH) * max_depth_m
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
    """Return the indentation (m, at least 0) at which the force on each clamp is `edge_force_n`."""
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
    """Suppress the sheet's advance towards the finger at small depths and small contact forces.

    depths: n depths (n,) of the finger in the object, m.
    indentation: indentations (n,) of the sheet, m. The advance is the indentation minus the depth.
    forces_n: contact forces (n,) at these depths.

    Returns the reduced indentations (n,), m. The advance increases smoothly from zero.
    """
    force_weight = _fade(forces_n, DEADBAND_START_N, DEADBAND_END_N)
    depth_weight = _fade(depths, DEADBAND_START_M, DEADBAND_END_M)
    advance = np.maximum(indentation - depths, 0.0)
    return np.asarray(indentation - (1.0 - force_weight * depth_weight) * advance)


def _fade(values: Floats, start: float, end: float) -> Floats:
    return smoothstep(np.clip((values - start) / (end - start), 0.0, 1.0))


def _saturate(indentation: Floats, maximum: float) -> Floats:
    """Limit n indentations (n,), m, to a maximum that they approach smoothly."""
    if maximum <= 0.0:
        return np.zeros_like(indentation)
    knee, span = (1.0 - SATURATION_FRACTION) * maximum, SATURATION_FRACTION * maximum
    over = np.maximum(indentation - knee, 0.0)
    result: Floats = np.minimum(indentation, knee) - span * np.expm1(-over / span)
    return result


@dataclass(frozen=True, slots=True)
class Compliance:
    """The sheet's offset and indentation as functions of the depth in one object.

    The offset is the distance of the sheet behind the object's tangent plane. The indentation is
    the depth minus the offset. The stretch is constant.

    note: text about forces that the sheet cannot render; empty if the sheet can render all forces.
    centre: forces that the sheet renders if its centre is pushed.
    _nodes: |x| and |y| (m) of the positions on the sheet at which the indentation was computed.
    _indentation, _growth: indentation at these positions as a function of depth, and its
        derivative.
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
        """Return the depth (m) beyond which the sheet moves with the finger."""
        return float(self.centre.depths_m[-1])

    def indentation_m(self, depths_m: Floats | float, position_m: SheetPosition = CENTRE) -> Floats:
        """Return the sheet's indentations (n,), m, at n depths of the finger in the object.

        depths_m: depths (n,).
        position_m: (x, y) of the contact on the sheet.
        """
        depths = np.clip(np.asarray(depths_m, dtype=np.float64), 0.0, self.max_depth_m)
        result: Floats = self._indentation(depths) @ self._weights(position_m)
        return result

    def normal_offset_m(
        self, depths_m: Floats | float, position_m: SheetPosition = CENTRE
    ) -> Floats:
        """Return the sheet's offsets (n,), m, behind the object's tangent plane.

        depths_m: n depths (n,) of the finger in the object. If a depth is not positive, there is no
            contact, and the offset is 0.
        position_m: (x, y) of the contact on the sheet.
        """
        depths = np.maximum(np.asarray(depths_m, dtype=np.float64), 0.0)
        result: Floats = depths - self.indentation_m(depths, position_m)
        return result

    def offset_per_depth(self, depth_m: float, position_m: SheetPosition = CENTRE) -> float:
        """Return the derivative of the sheet's normal offset with respect to the finger's depth.

        The normal offset is the distance of the sheet behind the object's tangent plane. The
        derivative is at most 1.
        """
        if depth_m <= 0.0:
            return 0.0
        if depth_m >= self.max_depth_m:
            return 1.0
        return 1.0 - float(self._growth(depth_m) @ self._weights(position_m))

    def choose_bandwidth_rad_per_s(self) -> tuple[float, bool]:
        """Choose the bandwidth (rad/s) of the depth filter, and return whether the loop is stable.

        The control loop with the hand is stable if the derivative of the sheet's offset with
        respect to the depth is within bounds. The bounds depend on the bandwidth. The result is the
        largest stable bandwidth, or the smallest bandwidth if none is stable. Without bounds, the
        bandwidth is infinite.
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
        """Return the forces (n,), N, that the sheet's model predicts at n depths (n,), m."""
        push = SheetPush(self.stretch_ratio, self.finger_radius_m, position_m)
        return self.model.evaluate(push, self.indentation_m(depths_m, position_m)).force_n

    def _weights(self, position_m: SheetPosition) -> Floats:
        """Return the weights (9,) for interpolation between the nine positions of `_nodes`.

        The interpolation is linear in x^2 and y^2. No weight is negative, so bounds that hold at
        these positions also hold between them.
        """
        weights = [
            _interpolate_squares(nodes, abs(at))
            for nodes, at in zip(self._nodes, position_m, strict=True)
        ]
        return np.outer(*weights).ravel()


def _interpolate_squares(nodes: Floats, at: float) -> Floats:
    """Return the n weights (n,) of an interpolation that is linear in the squared coordinate.

    nodes: coordinates (n,) of the known values.
    at: coordinate of the interpolated value.
    """
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
    """Find the stretch ratio and the sheet offset that best render a force curve.

    stretch_ratio: fixed stretch ratio; None to choose the best stretch ratio.
    max_depth_m: maximum depth of a push; None means the value of the scene.
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
    """Return a warning about forces that the sheet cannot render, or "" if it can render all.

    position_error_m: error of the sheet's position.

    The text also warns if the object is so soft that this error changes the force noticeably.
    """
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
            f"object is {kind} than the sheet can render: "
            f"{100 * abs(error[at]):.0f} % {than} at "
            f"{1e3 * rendered.depths_m[at]:.0f} mm ({rendered.force_n[at]:.2f} of "
            f"{rendered.object_force_n[at]:.2f} N), maximum {100 * np.abs(error).max():.0f} %; "
            f"{cause}; users notice {100 * WEBER_RATIO:.0f} to {100 * WEBER_RATIO_BARE:.0f} %"
        )
    uncertainty = compute_force_uncertainty_ratio(rendered, position_error_m)
    if uncertainty > WEBER_RATIO:
        return (
            f"object is too soft for the position tolerance: {1e3 * position_error_m:g} mm of the "
            f"sheet's position changes the force at {1e3 * rendered.depths_m[-1]:.0f} mm by "
            f"{100 * uncertainty:.0f} %; users notice {100 * WEBER_RATIO:.0f} to "
            f"{100 * WEBER_RATIO_BARE:.0f} %"
        )
    return ""


def compute_force_uncertainty_ratio(rendered: RenderedForce, position_error_m: float) -> float:
    """Return the relative change of the force at the maximum depth due to a position error (m)."""
    change = float(rendered.stiffness_n_per_m[-1]) * position_error_m
    return change / max(float(rendered.object_force_n[-1]), 1e-9)


def compute_stretch_range(sheet: SheetSpec) -> tuple[float, float]:
    """Return the minimum and maximum stretch ratio within the usable edge force and strain."""
    at_max_force = stretch_for_edge_force(USABLE_FRACTION * sheet.max_edge_force_n, sheet)
    at_max_strain = 1.0 + USABLE_FRACTION * (sheet.max_stretch_ratio - 1.0)
    return sheet.min_stretch_ratio, max(sheet.min_stretch_ratio, min(at_max_strain, at_max_force))


def choose_stretch(stiffness_n_per_m: float, sheet: SheetSpec) -> tuple[float, str]:
    """Return the stretch at which the sheet's stiffness at small deflections matches the object's.

    The second result is a note. It is empty unless the object is softer or stiffer than the sheet
    can be. The sheet is modelled as linear, and the fingertip as a point.
    """
    least, largest = compute_stretch_range(sheet)
    desired = stretch_for_edge_force(
        edge_force_for_stiffness(stiffness_n_per_m, width_m=sheet.width_m), sheet
    )
    stretch = min(max(desired, least), largest)
    force = edge_force_n(stretch, sheet)
    rendered = push_stiffness_n_per_m(force, width_m=sheet.width_m)
    if desired < least:
        problem = "softer"
    elif desired > largest:
        problem = "stiffer"
    else:
        return stretch, ""
    note = f"object of {stiffness_n_per_m:.0f} N/m is {problem} than the sheet, {rendered:.0f} N/m"
    return stretch, note
