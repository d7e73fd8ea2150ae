"""How the sheet yields: it follows what the soft body tells of the object, place by place."""

from __future__ import annotations

from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.scene import Scene
from flexsheet.messages.types import SoftBody
from flexsheet.nodes.models.sheet.force_models import CENTRE, Place, SheetForceModel
from flexsheet.nodes.planner.compliance import (
    FELT_N,
    Compliance,
    ObjectCurve,
    compliance_at,
    compliance_for,
    fit_compliance,
    pull_of,
)

Floats = NDArray[np.float64]

Presents = Literal["curve", "stretch"]

SAME_RATIO = 0.02
"""Curves that differ by less than this are taken for the same: a seventh of what people notice."""

COMPARED_SHARES = np.array([0.04, 0.1, 0.25, 0.5, 1.0])
"""Depths at which curves are compared, over the deepest push."""


class Yielding:
    """The stretch and the retreat for the object where the finger is.

    presents: "curve", the object's force over depth; or "stretch", its stiffness at small pushes
    alone, by a stretch (the paper's way).
    """

    def __init__(self, scene: Scene, law: SheetForceModel, presents: Presents) -> None:
        self.stretch_ratio = scene.sheet.min_stretch_ratio
        self.note = ""
        self._scene, self._law, self._presents = scene, law, presents
        self._pull = pull_of(scene.sheet, law)
        self._compared_m = scene.working_range.push_depth_m * COMPARED_SHARES
        self._fitted_n: Floats | None = None
        self._compliance: Compliance | None = None

    def take(self, soft_body: SoftBody, *, touching: bool) -> None:
        """Go over to the object as it is here.  In touch the stretch stays: edges that move would
        be felt.  UnfitCurveError for a force curve that is none; all stays as it was then.
        """
        if self._presents == "stretch":
            if soft_body.stiffness_n_per_m > 0.0:
                choice = compliance_for(soft_body.stiffness_n_per_m, self._scene.sheet)
                self.stretch_ratio, self.note = choice.stretch_ratio, choice.note
            return
        rows = soft_body.force_curve
        if len(rows) == 0:
            return
        forces_n = np.interp(self._compared_m, rows[:, 0], rows[:, 1])
        if self._fitted_n is not None and _same(forces_n, self._fitted_n):
            return
        self._fit(ObjectCurve.from_rows(rows), touching=touching)
        self._fitted_n = forces_n

    def _fit(self, curve: ObjectCurve, *, touching: bool) -> None:
        scene = self._scene
        fit = fit_compliance
        if touching and self._compliance is not None:
            fit = partial(compliance_at, stretch_ratio=self._compliance.stretch_ratio)
        fitted = fit(
            curve,
            self._law,
            self._pull,
            deepest_m=scene.working_range.push_depth_m,
            finger_radius_m=scene.finger.radius_m,
            usable_half_height_m=scene.sheet.usable_half_height_m,
            position_error_m=scene.tolerances.sheet_position_m,
        )
        self._compliance = fitted
        self.stretch_ratio = fitted.stretch_ratio
        self.note = "; ".join(filter(None, (fitted.note, self._beyond_law(fitted))))

    def _beyond_law(self, fitted: Compliance) -> str:
        """Why the law is not to be trusted for the deepest push at the sheet's middle, or nothing;
        what is asked is how deep the finger is in the sheet then."""
        deepest_m = self._scene.working_range.push_depth_m
        why = self._law.invalid_reason(
            fitted.stretch_ratio,
            float(fitted.indentation_m(deepest_m)),
            place_m=CENTRE,
            finger_radius_m=self._scene.finger.radius_m,
        )
        return f"beyond the {self._law.name} law of the sheet's force: {why}" if why else ""

    def retreat(self, depth_m: float, place_m: Place) -> tuple[float, float]:
        """How far (m) the sheet shall be behind the object's tangent plane for a finger so deep in
        the object, at a place (x, y) of the sheet, and how that grows with the depth."""
        if self._compliance is None or depth_m <= 0.0:
            return 0.0, 0.0
        return (
            float(self._compliance.retreat_m(depth_m, place_m)),
            self._compliance.retreat_per_depth(depth_m, place_m),
        )


def _same(forces_n: Floats, others_n: Floats) -> bool:
    difference = np.abs(forces_n - others_n) / np.maximum(others_n, FELT_N)
    return bool((difference < SAME_RATIO).all())
