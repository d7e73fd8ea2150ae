"""How the sheet is stretched and moved so that it yields to the finger as the object would.

A finger `d` deep in the object, if the sheet stood in the object's tangent plane, would push the
sheet in by `d`, and only at one depth would the sheet answer with the object's force.  So the sheet
is also moved along its normal: it retreats by r(d) (or, below zero, comes towards the finger), and
the indentation that is left, i = d - r, is the one at which the sheet's law gives the object's
force:

    F_sheet(stretch, d - r(d)) = F_object(d).

A retreat takes work from a finger that pushes while the sheet lags behind, so it damps; an advance
gives it work: with lag t and sheet stiffness k, as a damper of -k a t would.  Hence the bound a on
the advance, and hence the choice of the stretch: the least one that presents the curve without an
advance, or with the smallest.

While a push is hardly felt the sheet does not come towards the finger: one that only strokes, and
what the camera adds to its height, must not be answered.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, PchipInterpolator

from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.scene import SheetSpec
from flexsheet.nodes.models.sheet import (
    edge_force_for_stiffness,
    edge_force_n,
    push_stiffness_n_per_m,
    stretch_for_edge_force,
)
from flexsheet.nodes.models.sheet.force_models import (
    CENTRE,
    Place,
    SheetForceModel,
    depth_for_force,
    interpolated_inverse,
)

Floats = NDArray[np.float64]

RESERVE = 0.85
"""Share of the largest edge force and strain that is planned with.

The bridges stop the arms where commanded or measured poses reach the limits themselves; two arms
that move are never exactly as far apart as planned (one sees the other a cycle or two late).
"""

FELT_N = 0.05
"""Forces below this are not compared, but as if they were this large: those of the first 2 mm into
an object of 4 kPa, which the soft body itself knows to a tenth at best."""

QUIET_N, ANSWERED_N = 0.25 * FELT_N, FELT_N
"""Up to the first force, the object's or the sheet's, the sheet does not come towards the finger;
from the second on as far as it takes."""

QUIET_M, ANSWERED_M = 0.3e-3, 1.2e-3
"""The same for depths: a third of a millimetre may be a fingertip that lies on the object."""

GOOD_RATIO = 0.10
"""Error of the presented force, over the wanted, that is aimed for."""

WEBER_RATIO, WEBER_RATIO_BARE = 0.15, 0.22
"""Least relative difference of stiffness that people notice: with the skin's deformation as a cue
(Bergmann Tiest & Kappers 2009), and without work or terminal force as a cue (Tan et al. 1995)."""

ADVANCE_PER_DEPTH = 0.5
"""How far the sheet may come towards the finger per depth of push: presents up to 1.5 times the
sheet's own stiffness, and with 10 ms of lag at 100 N/m takes 0.5 N s/m of damping, less than a
finger has."""

CANDIDATES = 17
"""Stretches that are tried between the least and the largest."""


class UnfitCurveError(FlexsheetError, ValueError):
    """A force curve that is no curve; the message says what is wrong with it."""

    code = "force-curve"
    remedy = "Give force over depth from zero, rising, without repeated depths."


@dataclass(frozen=True, slots=True)
class ObjectCurve:
    """The object's force over depth: rows (n,) from (0, 0), depths ascending, forces not falling.

    Between the rows a monotone cubic; beyond the last a straight line at the last slope.
    """

    depths_m: Floats
    forces_n: Floats
    _curve: PchipInterpolator = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """UnfitCurveError unless there are two rows or more, finite and in order."""
        depths, forces = self.depths_m, self.forces_n
        if depths.ndim != 1 or len(depths) < 2 or depths.shape != forces.shape:
            raise UnfitCurveError(
                f"a force curve of {depths.shape} depths and {forces.shape} forces; it takes as "
                "many forces as depths, two or more"
            )
        if not (np.isfinite(depths).all() and np.isfinite(forces).all()):
            raise UnfitCurveError("a force curve has entries that are not finite")
        if depths[0] != 0.0 or forces[0] != 0.0:
            raise UnfitCurveError(
                f"a force curve begins at {depths[0]:g} m, {forces[0]:g} N; it must begin at 0, 0"
            )
        if (np.diff(depths) <= 0.0).any() or (np.diff(forces) < 0.0).any():
            raise UnfitCurveError("a force curve's depths must ascend and its forces not fall")
        object.__setattr__(self, "_curve", PchipInterpolator(depths, forces))

    @classmethod
    def from_rows(cls, rows: Floats) -> ObjectCurve:
        """From `SoftBody.force_curve`: (n, 2) depth and force."""
        return cls(np.ascontiguousarray(rows[:, 0]), np.ascontiguousarray(rows[:, 1]))

    @classmethod
    def linear(cls, stiffness_n_per_m: float, deepest_m: float) -> ObjectCurve:
        """Of a spring."""
        return cls(np.array([0.0, deepest_m]), np.array([0.0, stiffness_n_per_m * deepest_m]))

    def force_n(self, depths_m: Floats) -> Floats:
        """Forces (n,) at depths (n,); 0 before the touch."""
        last = self.depths_m[-1]
        inside = self._curve(np.clip(depths_m, 0.0, last))
        beyond = np.maximum(np.asarray(depths_m) - last, 0.0)
        result: Floats = inside + beyond * float(self._curve(last, 1))
        return result


@dataclass(frozen=True, slots=True)
class Pull:
    """What the sheet and the arms that hold it may be asked for."""

    least_stretch: float
    largest_stretch: float
    edge_force_n: float
    advance_per_depth: float = ADVANCE_PER_DEPTH


def pull_of(sheet: SheetSpec, law: SheetForceModel) -> Pull:
    """The scene's limits less the reserve; a pushed sheet pulls harder, see `present`."""
    force = RESERVE * sheet.max_edge_force_n
    least = sheet.min_stretch_ratio
    low, high = least, max(least, 1.0 + RESERVE * (sheet.max_stretch_ratio - 1.0))
    if _flat_pull_n(law, high) > force:
        for _ in range(40):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if _flat_pull_n(law, middle) > force else (middle, high)
        high = low
    return Pull(least, high, force)


def _flat_pull_n(law: SheetForceModel, stretch_ratio: float) -> float:
    """Force (N) on each clamp of the unpushed sheet."""
    pressed = law.evaluate(
        stretch_ratio, np.zeros(1), place_m=CENTRE, finger_radius_m=0.03 * law.rubber.width_m
    )
    return float(pressed.edge_force_n[0])


@dataclass(frozen=True, slots=True)
class Presented:
    """What a stretch presents at one place, a row per depth (n,).

    edge_force_n: on each clamp.  advance_per_depth: the fastest that the sheet comes towards the
    finger.  pull_bound: whether the arms' pull kept the sheet from pressing as it should.
    """

    depths_m: Floats
    wanted_n: Floats
    force_n: Floats
    stiffness_n_per_m: Floats
    indentation_m: Floats
    edge_force_n: Floats
    advance_per_depth: float
    pull_bound: bool

    @property
    def retreat_m(self) -> Floats:
        return self.depths_m - self.indentation_m

    @property
    def error_ratio(self) -> Floats:
        """(n,) presented over wanted, less one; 0 where neither can be felt."""
        felt = np.maximum(self.wanted_n, self.force_n) >= FELT_N
        difference = (self.force_n - self.wanted_n) / np.maximum(self.wanted_n, FELT_N)
        result: Floats = np.where(felt, difference, 0.0)
        return result


_KNOTS = np.concatenate([np.zeros(3), np.geomspace(4e-3, 1.0, 56), np.ones(2)])
DEPTH_SHARES = 0.5 * (_KNOTS[1:-2] + _KNOTS[2:-1])
"""Depths, over the deepest, at which the retreat is worked out: denser where contact grows.

They are the places of the control points of a quadratic B-spline on `_KNOTS` (Greville), which then
is smooth (C1) and has no steeper slope than the straight lines between its control points: bounds
on the slope at these depths hold everywhere, as they would not for a curve through the points.
"""

PULL_BEND = 0.1
"""Share of the largest indentation over which it is approached, not met with a kink."""


def present(
    curve: ObjectCurve,
    law: SheetForceModel,
    pull: Pull,
    *,
    stretch_ratio: float,
    deepest_m: float,
    place_m: Place = CENTRE,
    finger_radius_m: float,
) -> Presented:
    """The best that this stretch can do for the curve at this place, within the pull.

    The indentation never makes the clamps pull harder than `pull.edge_force_n` (beyond, the sheet
    gives way with the finger), and grows by at most 1 + `pull.advance_per_depth` per depth.
    """
    depths = deepest_m * DEPTH_SHARES
    wanted = curve.force_n(depths)
    asked = depth_for_force(
        law,
        stretch_ratio,
        wanted,
        deepest_m=(1.0 + pull.advance_per_depth) * deepest_m,
        place_m=place_m,
        finger_radius_m=finger_radius_m,
    )
    own = law.evaluate(stretch_ratio, depths, place_m=place_m, finger_radius_m=finger_radius_m)
    asked = _quietly(depths, asked, np.maximum(wanted, own.force_n))
    furthest = _indentation_for_pull(
        law,
        pull.edge_force_n,
        stretch_ratio=stretch_ratio,
        deepest_m=deepest_m,
        place_m=place_m,
        finger_radius_m=finger_radius_m,
    )
    held = _bent(asked, furthest)
    growth = (1.0 + pull.advance_per_depth) * depths
    indentation = growth + np.minimum.accumulate(held - growth)
    pressed = law.evaluate(
        stretch_ratio, indentation, place_m=place_m, finger_radius_m=finger_radius_m
    )
    steps = np.diff(indentation) / np.diff(depths)
    return Presented(
        depths_m=depths,
        wanted_n=wanted,
        force_n=pressed.force_n,
        stiffness_n_per_m=pressed.stiffness_n_per_m,
        indentation_m=indentation,
        edge_force_n=pressed.edge_force_n,
        advance_per_depth=max(0.0, float(steps.max()) - 1.0),
        pull_bound=bool(asked.max() > (1.0 - PULL_BEND) * furthest),
    )


def _indentation_for_pull(
    law: SheetForceModel,
    edge_n: float,
    *,
    stretch_ratio: float,
    deepest_m: float,
    place_m: Place,
    finger_radius_m: float,
) -> float:
    """The indentation (m) at which the clamps pull with `edge_n`; 0 if they do so unpushed."""
    grid = 2.0 * deepest_m * DEPTH_SHARES[1:]
    flat = _flat_pull_n(law, stretch_ratio)
    if flat >= edge_n:
        # Reached by rounding only: `pull_of` keeps the flat sheet within the pull.
        return 0.0 if flat > edge_n * (1.0 + 1e-6) else float(grid[0])
    pulled = law.evaluate(stretch_ratio, grid, place_m=place_m, finger_radius_m=finger_radius_m)
    added = pulled.edge_force_n - flat
    if added[-1] <= edge_n - flat:
        return float(grid[-1])
    return float(interpolated_inverse(grid, added, np.array([edge_n - flat]))[0])


def _quietly(depths: Floats, asked: Floats, forces_n: Floats) -> Floats:
    """Indentations (n,) as asked, but beyond the depths only as far as forces are felt (C1)."""
    felt = _smoothstep((forces_n - QUIET_N) / (ANSWERED_N - QUIET_N))
    deep = _smoothstep((depths - QUIET_M) / (ANSWERED_M - QUIET_M))
    beyond = np.maximum(asked - depths, 0.0)
    return np.asarray(asked - (1.0 - felt * deep) * beyond)


def _smoothstep(values: Floats) -> Floats:
    """From 0 at 0 to 1 at 1, level at both (C1)."""
    share = np.clip(values, 0.0, 1.0)
    return np.asarray(share * share * (3.0 - 2.0 * share))


def _bent(asked: Floats, furthest: float) -> Floats:
    """Follows `asked`, then bends (C1) towards `furthest` and never passes it."""
    if furthest <= 0.0:
        return np.zeros_like(asked)
    knee, span = (1.0 - PULL_BEND) * furthest, PULL_BEND * furthest
    over = np.maximum(asked - knee, 0.0)
    result: Floats = np.minimum(asked, knee) - span * np.expm1(-over / span)
    return result


@dataclass(frozen=True, slots=True)
class Compliance:
    """One object presented by one stretch: where the sheet goes for each depth of the finger.

    stretch_ratio: constant over the push.  note: empty, or what the sheet cannot present and by
    how much.  centre: the whole push at the sheet's middle.
    """

    stretch_ratio: float
    note: str
    centre: Presented
    law: SheetForceModel
    pull: Pull
    finger_radius_m: float
    _nodes: tuple[Floats, Floats]
    _indentation: BSpline = field(repr=False)
    _growth: BSpline = field(repr=False)

    @property
    def deepest_m(self) -> float:
        """To here the push was worked out; deeper the sheet goes with the finger."""
        return float(self.centre.depths_m[-1])

    def indentation_m(self, depths_m: Floats | float, place_m: Place = CENTRE) -> Floats:
        """How deep the finger shall push the sheet in, (n,), with the finger at depths (n,)."""
        depths = np.clip(np.asarray(depths_m, dtype=np.float64), 0.0, self.deepest_m)
        result: Floats = self._indentation(depths) @ self._weights(place_m)
        return result

    def retreat_m(self, depths_m: Floats | float, place_m: Place = CENTRE) -> Floats:
        """How far behind the object's tangent plane the sheet shall be, (n,); below 0: before it.

        Smooth (C1) in the depth, continuous in the place; 0 while the finger does not touch.
        """
        depths = np.maximum(np.asarray(depths_m, dtype=np.float64), 0.0)
        result: Floats = depths - self.indentation_m(depths, place_m)
        return result

    def retreat_per_depth(self, depth_m: float, place_m: Place = CENTRE) -> float:
        """How fast the retreat grows with the depth: from -`pull.advance_per_depth` to 1."""
        if depth_m <= 0.0:
            return 0.0
        if depth_m >= self.deepest_m:
            return 1.0
        return 1.0 - float(self._growth(depth_m) @ self._weights(place_m))

    def presented(self, depths_m: Floats, place_m: Place = CENTRE) -> Floats:
        """The force (n,), N, that the sheet then answers with, by its law."""
        return self.law.evaluate(
            self.stretch_ratio,
            self.indentation_m(depths_m, place_m),
            place_m=place_m,
            finger_radius_m=self.finger_radius_m,
        ).force_n

    def _weights(self, place_m: Place) -> Floats:
        """Of the nodes (9,): linear in x^2 and y^2 between them, as the sheet is even.

        None is negative, so that what holds at the nodes (pull, advance, no step back) holds
        between them.
        """
        along = [_shares(nodes, abs(at)) for nodes, at in zip(self._nodes, place_m, strict=True)]
        return np.outer(*along).ravel()


def _shares(nodes: Floats, at: float) -> Floats:
    """Weights (n,) of the nodes (n,) at a place: linear in the square, constant beyond the last."""
    squares, square = nodes**2, min(at, float(nodes[-1])) ** 2
    upper = int(np.clip(np.searchsorted(squares, square), 1, len(nodes) - 1))
    share = (square - squares[upper - 1]) / (squares[upper] - squares[upper - 1])
    weights = np.zeros(len(nodes))
    weights[upper - 1], weights[upper] = 1.0 - share, share
    return weights


def fit_compliance(
    curve: ObjectCurve,
    law: SheetForceModel,
    pull: Pull,
    *,
    deepest_m: float,
    finger_radius_m: float,
    usable_half_height_m: float,
    position_error_m: float,
) -> Compliance:
    """The stretch and the retreat that present the curve best to pushes of `deepest_m`.

    position_error_m: how exactly the sheet is held in place (the scene's tolerance); an object so
    soft that this much changes its force beyond what people notice is noted as such.
    """
    stretches = np.linspace(pull.least_stretch, pull.largest_stretch, CANDIDATES)
    tried = [
        present(
            curve,
            law,
            pull,
            stretch_ratio=float(stretch),
            deepest_m=deepest_m,
            finger_radius_m=finger_radius_m,
        )
        for stretch in np.unique(stretches)
    ]
    worst = [float(np.abs(one.error_ratio).max()) for one in tried]
    allowed = max(min(worst) + 0.01, 0.02)
    chosen = min(
        (number for number, error in enumerate(worst) if error <= allowed),
        key=lambda number: (round(tried[number].advance_per_depth, 2), number),
    )
    return compliance_at(
        curve,
        law,
        pull,
        stretch_ratio=float(np.unique(stretches)[chosen]),
        deepest_m=deepest_m,
        finger_radius_m=finger_radius_m,
        usable_half_height_m=usable_half_height_m,
        position_error_m=position_error_m,
    )


def compliance_at(
    curve: ObjectCurve,
    law: SheetForceModel,
    pull: Pull,
    *,
    stretch_ratio: float,
    deepest_m: float,
    finger_radius_m: float,
    usable_half_height_m: float,
    position_error_m: float,
) -> Compliance:
    """The retreat for a curve at a given stretch: for an object that feels otherwise elsewhere."""
    rubber = law.rubber
    xs = 0.5 * rubber.width_m * np.array([0.0, 0.3, 0.5])
    ys = min(usable_half_height_m, 0.4 * rubber.height_m) * np.array([0.0, 0.6, 1.0])
    at_nodes = [
        present(
            curve,
            law,
            pull,
            stretch_ratio=stretch_ratio,
            deepest_m=deepest_m,
            place_m=(float(x), float(y)),
            finger_radius_m=finger_radius_m,
        )
        for x in xs
        for y in ys
    ]
    indentation = BSpline(
        deepest_m * _KNOTS, np.column_stack([one.indentation_m for one in at_nodes]), 2
    )
    return Compliance(
        stretch_ratio=stretch_ratio,
        note=_note(at_nodes[0], position_error_m),
        centre=at_nodes[0],
        law=law,
        pull=pull,
        finger_radius_m=finger_radius_m,
        _nodes=(xs, ys),
        _indentation=indentation,
        _growth=indentation.derivative(),
    )


def _note(shown: Presented, position_error_m: float) -> str:
    """What the sheet cannot present of a push, and by how much; empty if it can."""
    error = shown.error_ratio
    off = np.abs(error) > GOOD_RATIO
    if off.any():
        # Where it is off by most newtons: that is what a finger will notice first.
        at = int(np.argmax(np.where(off, np.abs(shown.force_n - shown.wanted_n), 0.0)))
        cause = (
            "the arms may not pull harder"
            if shown.pull_bound
            else "the sheet may not come towards the finger faster"
        )
        kind, than = ("stiffer", "too soft") if error[at] < 0.0 else ("softer", "too stiff")
        return (
            f"object is {kind} than the sheet can present: {100 * abs(error[at]):.0f} % {than} at "
            f"{1e3 * shown.depths_m[at]:.0f} mm ({shown.force_n[at]:.2f} of "
            f"{shown.wanted_n[at]:.2f} N), {100 * np.abs(error).max():.0f} % at most; {cause}; "
            f"people notice {100 * WEBER_RATIO:.0f} to {100 * WEBER_RATIO_BARE:.0f} %"
        )
    unsure = unsureness(shown, position_error_m)
    if unsure > WEBER_RATIO:
        return (
            f"object is softer than the sheet presents surely: {1e3 * position_error_m:g} mm of "
            f"the sheet's place is {100 * unsure:.0f} % of the force at "
            f"{1e3 * shown.depths_m[-1]:.0f} mm; people notice {100 * WEBER_RATIO:.0f} to "
            f"{100 * WEBER_RATIO_BARE:.0f} %"
        )
    return ""


def unsureness(shown: Presented, position_error_m: float) -> float:
    """The relative change of the deepest push's force by an error of the sheet's place."""
    change = float(shown.stiffness_n_per_m[-1]) * position_error_m
    return change / max(float(shown.wanted_n[-1]), 1e-9)


@dataclass(frozen=True, slots=True)
class StretchChoice:
    """A stretch that presents an object's stiffness; `note` says so where the sheet cannot."""

    stretch_ratio: float
    note: str


def stretch_range(sheet: SheetSpec) -> tuple[float, float]:
    """Least and largest stretch: the scene's, and what the arms may pull, less the reserve."""
    strongest = stretch_for_edge_force(
        RESERVE * sheet.max_edge_force_n,
        young_modulus_pa=sheet.young_modulus_pa,
        height_m=sheet.height_m,
        thickness_m=sheet.thickness_m,
    )
    longest = 1.0 + RESERVE * (sheet.max_stretch_ratio - 1.0)
    return sheet.min_stretch_ratio, max(sheet.min_stretch_ratio, min(longest, strongest))


def compliance_for(stiffness_n_per_m: float, sheet: SheetSpec) -> StretchChoice:
    """The stretch for an object of that stiffness (N/m, small pushes) when the sheet only tilts.

    By the linear law: it knows neither the object's curve nor the fingertip.
    """
    least, largest = stretch_range(sheet)
    wanted = stretch_for_edge_force(
        edge_force_for_stiffness(stiffness_n_per_m, width_m=sheet.width_m),
        young_modulus_pa=sheet.young_modulus_pa,
        height_m=sheet.height_m,
        thickness_m=sheet.thickness_m,
    )
    stretch = min(max(wanted, least), largest)
    force = edge_force_n(
        stretch,
        young_modulus_pa=sheet.young_modulus_pa,
        height_m=sheet.height_m,
        thickness_m=sheet.thickness_m,
    )
    presented = push_stiffness_n_per_m(force, width_m=sheet.width_m)
    note = ""
    if wanted < least:
        note = f"object of {stiffness_n_per_m:.0f} N/m is softer than the sheet's {presented:.0f}"
    elif wanted > largest:
        note = f"object of {stiffness_n_per_m:.0f} N/m is stiffer than the sheet's {presented:.0f}"
    return StretchChoice(stretch, note)
