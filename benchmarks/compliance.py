"""Compare the rendered force of soft to stiff objects with the simulator's membrane.

OPENBLAS_NUM_THREADS=1 python -m benchmarks.compliance

The object of the scene is used with several Young's moduli. The force-depth curve is computed by
the soft body. For each modulus, the planner selects the stretch and the advance of the sheet, and
the simulated sheet gives the force on a finger at each depth. A sheet with stretch but without
advance is measured for comparison.

The program also prints the force errors at other points of the sheet, and the range of moduli that
the sheet can render. It takes two minutes.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from flexsheet.launch.calibration.simulated_sheet import simulate_force
from flexsheet.launch.health.compliance import (
    LINEAR_DEPTH_M,
    compute_compliance,
    compute_front_curve,
)
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.scene import Scene, require_material
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.sheet.force_models import CENTRE, SheetForceModel, SheetPosition
from flexsheet.nodes.planner.compliance import (
    FORCE_JND_FLOOR_N,
    TARGET_ERROR_RATIO,
    WEBER_RATIO,
    WEBER_RATIO_BARE,
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
    rows, modulus = compute_front_curve(scene), require_material(scene).young_modulus_pa
    return lambda wanted: ObjectCurve.from_rows(rows * [1.0, wanted / modulus])


def errors(
    scene: Scene, stretch: float, pushed_m: Floats, wanted_n: Floats, place: SheetPosition = CENTRE
) -> Floats:
    """Return the relative force errors (n,) with the sheet pushed in by `pushed_m` (n,)."""
    radius = scene.finger.radius_m
    true = [simulate_force(scene.sheet, stretch, float(depth), place, radius) for depth in pushed_m]
    error: Floats = (np.array(true) - wanted_n) / np.maximum(wanted_n, FORCE_JND_FLOOR_N)
    return error


def row(name: str, values: Floats) -> str:
    return f"{name:<28}" + "".join(f"{100 * value:>8.1f}" for value in values)


def describe_error(error: Floats) -> str:
    worst = float(np.abs(error).max())
    if worst <= TARGET_ERROR_RATIO:
        return f"within {100 * TARGET_ERROR_RATIO:.0f} %"
    if worst <= WEBER_RATIO:
        return f"below the just noticeable difference ({100 * WEBER_RATIO:.0f} %)"
    return f"noticeable ({100 * worst:.0f} %; {100 * WEBER_RATIO:.0f}-{100 * WEBER_RATIO_BARE:.0f})"


def materials(scene: Scene, law: SheetForceModel, depths: Floats) -> None:
    curve_of = object_curve(scene)
    print(f"{'error, % of wanted, at':<28}" + "".join(f"{1e3 * d:>5.0f} mm" for d in depths))
    for modulus in MODULI_PA:
        curve = curve_of(modulus)
        wanted = curve.force_n(depths)
        shown = compute_compliance(scene, law, curve, max_depth_m=float(depths[-1]))
        error = errors(scene, shown.stretch_ratio, shown.indentation_m(depths), wanted)
        stiffness = float(curve.force_n(np.array([LINEAR_DEPTH_M]))[0]) / LINEAR_DEPTH_M
        old = choose_stretch(stiffness, scene.sheet)[0]
        before = errors(scene, old, depths, wanted)
        print(
            f"{1e-3 * modulus:g} kPa, {stiffness:.0f} N/m: stretch {shown.stretch_ratio:.3f}, "
            f"advance {shown.centre.advance_per_depth:.2f}, clamps "
            f"{shown.centre.edge_force_n.max():.1f} N: {describe_error(error)}"
        )
        print("  wanted, N" + " " * 17 + "".join(f"{force:>8.3f}" for force in wanted))
        retreat = 1e3 * shown.normal_offset_m(depths)
        print("  retreat, mm" + " " * 15 + "".join(f"{one:>8.2f}" for one in retreat))
        print(row("  stretch and retreat", error))
        print(row(f"  stretch {old:.3f} alone", before))
        if shown.note:
            print(f"  {shown.note}")


def places(scene: Scene, law: SheetForceModel, depths: Floats) -> None:
    curve = object_curve(scene)(PLACES_MODULUS_PA)
    shown = compute_compliance(scene, law, curve, max_depth_m=float(depths[-1]))
    print(f"\n{1e-3 * PLACES_MODULUS_PA:g} kPa at places of the sheet, error %")
    for place in PLACES:
        pushed = shown.indentation_m(depths, place)
        error = errors(scene, shown.stretch_ratio, pushed, curve.force_n(depths), place)
        where = f"  x {1e3 * place[0]:.0f}, y {1e3 * place[1]:.0f} mm"
        print(row(where, error) + f"   {describe_error(error)}")


def limits(scene: Scene, law: SheetForceModel, max_depth_m: float) -> None:
    """Print the softest and the stiffest modulus that the force model allows."""
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

    stiffest = border(fits, 1000.0, 1e6)
    softest = border(sure, 4000.0, 10.0)
    for name, modulus in (("softest", softest), ("stiffest", stiffest)):
        stiffness = curve_of(modulus).force_n(np.array([LINEAR_DEPTH_M]))[0] / LINEAR_DEPTH_M
        print(
            f"{name} to {1e3 * max_depth_m:.0f} mm: {modulus:.0f} Pa, {stiffness:.0f} N/m at "
            f"{1e3 * LINEAR_DEPTH_M:.0f} mm"
        )


def main() -> None:
    scene = load_scene(SCENE_FILE)
    law = make_force_model(scene.sheet)
    print(f"scene {scene.name}, law {law.name}; 0.05 N and more are compared")
    materials(scene, law, DEPTHS_M)
    places(scene, law, DEPTHS_M)
    print()
    for deepest in (0.010, 0.020, 0.050):
        limits(scene, law, deepest)


if __name__ == "__main__":
    main()
