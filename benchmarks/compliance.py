"""Compare the rendered force of soft to stiff objects with the simulator's membrane.

OPENBLAS_NUM_THREADS=1 python -m benchmarks.compliance [--json]

The object of the scene is used with several Young's moduli. The force-depth curve is computed by
the soft body. For each modulus, the planner selects the stretch and the advance of the sheet, and
the simulated sheet gives the force on a finger at each depth. A sheet with stretch but without
advance is measured for comparison.

The program also measures the force errors at other points of the sheet, and the range of moduli
that the sheet can render. Errors are relative to the force of the object, or to 0.05 N if this is
larger. It takes two minutes.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.messaging import print_report
from flexsheet.launch.calibration.simulated_sheet import simulate_force
from flexsheet.launch.health.compliance import compute_compliance, compute_front_curve
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.scene import Scene, require_material
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.fem_solver.body import LINEAR_DEPTH_M
from flexsheet.nodes.models.sheet.force_models import CENTRE, SheetForceModel, SheetPosition
from flexsheet.nodes.planner.compliance import (
    FORCE_JND_FLOOR_N,
    TARGET_ERROR_RATIO,
    WEBER_RATIO,
    ObjectCurve,
    choose_stretch,
    compute_force_uncertainty_ratio,
)
from flexsheet.nodes.planner.sheet_force import make_force_model

SCENE_FILE = Path(__file__).resolve().parent.parent / "launch" / "scenes" / "cylinder.yaml"
MODULI_PA = (500.0, 1000.0, 2000.0, 4000.0, 6000.0, 8000.0, 16000.0)
DEPTHS_M = np.array([0.002, 0.005, 0.010, 0.020, 0.035, 0.050])
PLACES: tuple[SheetPosition, ...] = (
    CENTRE,
    (0.03, 0.02),
    (0.055, 0.0),
    (0.0, 0.085),
    (0.045, 0.06),
)
PLACES_MODULUS_PA = 3000.0


def object_curve(scene: Scene) -> Callable[[float], ObjectCurve]:
    """Compute the force-depth curve of the scene's object, divided by its Young's modulus."""
    rows = compute_front_curve(scene, None, print)
    modulus = require_material(scene).young_modulus_pa
    return lambda wanted: ObjectCurve.from_rows(rows * [1.0, wanted / modulus])


def errors(
    scene: Scene, stretch: float, pushed_m: Floats, wanted_n: Floats, place: SheetPosition = CENTRE
) -> Floats:
    """Return the relative force errors (n,) with the sheet pushed in by `pushed_m` (n,)."""
    radius = scene.finger.radius_m
    true = [simulate_force(scene.sheet, stretch, float(depth), place, radius) for depth in pushed_m]
    error: Floats = (np.array(true) - wanted_n) / np.maximum(wanted_n, FORCE_JND_FLOOR_N)
    return error


def largest_percent(errors: Floats) -> float:
    """Return the error with the largest absolute value, with its sign, in percent."""
    return 100.0 * float(errors[np.abs(errors).argmax()])


def materials(scene: Scene, law: SheetForceModel, depths: Floats) -> Iterator[dict[str, Any]]:
    """Yield the force errors for each modulus of the object."""
    curve_of = object_curve(scene)
    for modulus in MODULI_PA:
        curve = curve_of(modulus)
        wanted = curve.force_n(depths)
        shown = compute_compliance(scene, law, curve, max_depth_m=float(depths[-1]))
        error = errors(scene, shown.stretch_ratio, shown.indentation_m(depths), wanted)
        stiffness = float(curve.force_n(np.array([LINEAR_DEPTH_M]))[0]) / LINEAR_DEPTH_M
        stretch_alone = choose_stretch(stiffness, scene.sheet)[0]
        yield {
            "modulus_pa": round(modulus),
            "stiffness_n_per_m": stiffness,
            "stretch": shown.stretch_ratio,
            "advance_per_depth": shown.centre.advance_per_depth,
            "max_edge_force_n": float(shown.centre.edge_force_n.max()),
            "max_percent": largest_percent(error),
            "max_to_35_mm_percent": largest_percent(error[depths <= 0.035]),
            "stretch_alone_max_percent": largest_percent(
                errors(scene, stretch_alone, depths, wanted)
            ),
            "force_n": label_depths(depths, wanted),
            "retreat_mm": label_depths(depths, 1e3 * shown.normal_offset_m(depths)),
        }


def label_depths(depths: Floats, values: Floats) -> dict[str, float]:
    """Return values by depth, such as "2 mm"."""
    return {f"{1e3 * d:g} mm": float(one) for d, one in zip(depths, values, strict=True)}


def places(scene: Scene, law: SheetForceModel, depths: Floats) -> Iterator[dict[str, Any]]:
    """Yield the force errors at several places of the sheet, in percent."""
    curve = object_curve(scene)(PLACES_MODULUS_PA)
    shown = compute_compliance(scene, law, curve, max_depth_m=float(depths[-1]))
    for place in PLACES:
        pushed = shown.indentation_m(depths, place)
        error = errors(scene, shown.stretch_ratio, pushed, curve.force_n(depths), place)
        yield {
            "modulus_pa": round(PLACES_MODULUS_PA),
            "x_mm": 1e3 * place[0],
            "y_mm": 1e3 * place[1],
            "error_percent": label_depths(depths, 100.0 * error),
        }


def limits(scene: Scene, law: SheetForceModel, max_depth_m: float) -> dict[str, float]:
    """Return the softest and the stiffest modulus (Pa) that the force model allows."""
    curve_of = object_curve(scene)

    def fits(modulus: float) -> bool:
        shown = compute_compliance(scene, law, curve_of(modulus), max_depth_m=max_depth_m)
        return float(np.abs(shown.centre.error_ratio).max()) <= TARGET_ERROR_RATIO

    def sure(modulus: float) -> bool:
        shown = compute_compliance(scene, law, curve_of(modulus), max_depth_m=max_depth_m)
        return (
            compute_force_uncertainty_ratio(shown.centre, scene.tolerances.sheet_position_m)
            <= WEBER_RATIO
        )

    def border(holds: Callable[[float], bool], inside: float, outside: float) -> float:
        for _ in range(12):
            middle = float(np.sqrt(inside * outside))
            inside, outside = (middle, outside) if holds(middle) else (inside, middle)
        return inside

    return {
        "max_depth_mm": 1e3 * max_depth_m,
        "softest_pa": border(sure, 4000.0, 10.0),
        "stiffest_pa": border(fits, 1000.0, 1e6),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    scene = load_scene(SCENE_FILE)
    law = make_force_model(scene.sheet)
    report = {
        "materials": [*materials(scene, law, DEPTHS_M)],
        "places": [*places(scene, law, DEPTHS_M)],
        "range": [limits(scene, law, max_depth_m) for max_depth_m in (0.010, 0.020, 0.050)],
    }
    print_report(report, *report, as_json=options.json)


if __name__ == "__main__":
    main()
