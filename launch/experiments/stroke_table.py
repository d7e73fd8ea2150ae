"""Repeat the strokes of Table I of Furukawa et al. 2007, and report errors with their uncertainty.

Optional variants switch off single methods (ablations), or use a cylinder of twice the radius.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
from scipy.stats import t as student_t

from flexsheet.launch.experiments.run import make_settings, require_scene
from flexsheet.launch.experiments.sweep import Progress, Row, raise_if_all_failed, run_sweep
from flexsheet.launch.plans.apparatus import format_apparatus, load_apparatus
from flexsheet.launch.plans.documents import edit_yaml
from flexsheet.launch.plans.plan import load_graph
from flexsheet.messages.apparatus import nominal_apparatus
from flexsheet.messages.files import write_file
from flexsheet.messages.methods import TrackingMethod
from flexsheet.messages.scene import Scene, require_cylinder

FIRST_SEED = 4100
"""The random seed of the noise of finger and camera in the first stroke of the finger.

Charts and defaults use other seeds.
"""

CONFIDENCE = 0.95
RATES_HZ = (15.0, 30.0, 60.0)
RADIUS_FACTOR = 2.0
"""The ratio of the cylinder's radius in the variant to the radius in the scene.

The angle and distance errors in the paper's table agree for a radius of 70.7 mm, which is twice the
radius in the paper's text.
"""

ERRORS = ("delta_d_mm", "delta_theta_deg", "true_delta_d_mm", "true_delta_theta_deg")


@dataclass(frozen=True, slots=True)
class Variant:
    """A variant of the experiment, with settings that override parameters of the launch file."""

    name: str
    launch_file: Path
    settings: tuple[str, ...] = ()
    apparatus: str | None = None


def make_variants(
    launch_file: Path, folder: Path, *, apparatus: str | None, ablations: bool, radii: bool
) -> list[Variant]:
    """Return the variants to measure; the first variant is the given configuration.

    The files of the other variants are written to the folder.

    ablations: whether to include variants in which a single method is switched off.
    radii: whether to include a larger cylinder.
    """
    scene = require_scene(load_graph(launch_file))
    variants = [Variant("as configured", launch_file, apparatus=apparatus)]
    if ablations:
        variants += _make_ablations(launch_file, folder, scene, apparatus)
    if radii:
        radius_m = RADIUS_FACTOR * require_cylinder(scene).radius_m
        larger = write_radius_variant(launch_file, folder, radius_m)
        name = f"radius {1e3 * radius_m:.1f} mm"
        # The apparatus file belongs to the given object, so this variant has the nominal one.
        variants.append(Variant(name, larger))
    return variants


def _make_ablations(
    launch_file: Path, folder: Path, scene: Scene, apparatus: str | None
) -> list[Variant]:
    def vary(name: str, node_type: str, setting: str) -> Variant:
        settings = tuple(make_settings(launch_file, node_type, setting))
        return Variant(name, launch_file, settings, apparatus)

    variants = [vary("no prediction", "planner", "prediction_horizon_s=0")]
    variants += [
        vary(f"tracking {method}", "triangulator", f"tracking={method}")
        for method in get_args(TrackingMethod)
    ]
    variants.append(vary("stretch only", "planner", "compliance_mode=stiffness"))
    truth = nominal_apparatus(scene) if apparatus is None else load_apparatus(apparatus, scene)
    for rate_hz in RATES_HZ:
        camera = truth.camera.model_copy(update={"rate_hz": rate_hz})
        file = folder / f"camera-{rate_hz:g}-hz.yaml"
        write_file(file, format_apparatus(truth.model_copy(update={"camera": camera})))
        variants.append(
            Variant(f"camera {rate_hz:g} Hz", launch_file, apparatus=str(file.resolve()))
        )
    return variants


def write_radius_variant(launch_file: Path, folder: Path, radius_m: float) -> Path:
    """Write a scene and a launch file with another radius of the cylinder.

    Return the path of the launch file. The cylinder is moved, so that its front stays at the same
    position. Relative paths are replaced by absolute paths, because the new files are in another
    folder.
    """
    graph = load_graph(launch_file)
    added_m = radius_m - require_cylinder(require_scene(graph)).radius_m
    name = f"radius-{1e3 * radius_m:.1f}-mm"
    varied, result = folder / f"scene-{name}.yaml", folder / f"launch-{name}.yaml"
    assert graph.scene_file is not None  # Otherwise `require_scene` has raised an error.
    with edit_yaml(Path(graph.scene_file), varied) as scene:
        scene["object"]["geometry"]["radius_m"] = radius_m
        position = scene["object"]["world_from_object"]["position_m"]
        position[2] = float(position[2]) - added_m
    with edit_yaml(launch_file, result) as launch:
        launch["scene"] = str(varied.resolve())
        for node, spec in launch["nodes"].items():
            given = spec.get("parameters", {})
            for parameter in given:
                given[parameter] = graph.nodes[node].parameters[parameter]
    return result


def run_stroke_table(
    variants: Sequence[Variant],
    settings: Sequence[str],
    folder: Path,
    progress: Progress,
    *,
    seconds: float,
    repeats: int,
    workers: int = 1,
    scheduler: str | None = None,
) -> dict[str, Any]:
    """Run several finger strokes per variant with different seeds; return the results for JSON.

    seconds: duration of a stroke. repeats: number of strokes per variant.
    """
    common = {
        "experiment": "stroke",
        "seconds": seconds,
        "settings": list(settings),
        "graph": load_graph(variants[0].launch_file, settings=settings).hash,
        "apparatus": variants[0].apparatus,
    }
    trials: dict[str, dict[str, Any]] = {}
    for variant in variants:
        for number in range(repeats):
            seed = f"seed={FIRST_SEED + number}"
            trials[_trial_name(variant, number)] = {
                "kind": "stroke",
                "launch_file": str(variant.launch_file.resolve()),
                "apparatus": variant.apparatus,
                "seconds": seconds,
                "settings": [
                    *make_settings(variant.launch_file, "twin_finger", seed),
                    *variant.settings,
                    *settings,
                ],
            }
    rows = run_sweep(folder, common, trials, progress, workers=workers, scheduler=scheduler)
    raise_if_all_failed(rows, folder)
    table = [
        {
            "variant": variant.name,
            **summarize_strokes([rows[_trial_name(variant, number)] for number in range(repeats)]),
        }
        for variant in variants
    ]
    return {
        **{key: value for key, value in table[0].items() if key != "variant"},
        "seconds": seconds,
        "repeats": repeats,
        "confidence": CONFIDENCE,
        "rows": table,
        "bag": None,
        "folder": str(folder),
    }


def _trial_name(variant: Variant, number: int) -> str:
    return f"{variant.name.replace(' ', '-')}-{number:03d}"


def summarize_strokes(rows: Sequence[Row]) -> dict[str, Any]:
    """Summarize the display errors, latencies and lost messages of repeated finger strokes.

    The function `summarize_means` defines the statistics of the display errors. The result also
    contains the number of successful strokes, and the error texts of failed strokes.
    """
    good = [row for row in rows if "error" not in row]
    result: dict[str, Any] = {
        key: summarize_means([row[key] for row in good]) if good else None for key in ERRORS
    }
    latency: dict[str, dict[str, float | None]] = {}
    for event in good[0]["latency_ms"] if good else ():
        latency[event] = {
            quantile: _median([row["latency_ms"][event][quantile] for row in good])
            for quantile in ("p50", "p99")
        }
    result["latency_ms"] = latency
    result["drops"] = sum(row["drops"] for row in good)
    result["strokes"] = len(good)
    result["failed"] = [row["error"] for row in rows if "error" in row]
    return result


def summarize_means(strokes: Sequence[Mapping[str, float]]) -> dict[str, float | None]:
    """Summarize the errors of repeated finger strokes.

    mean: mean of the strokes' mean errors.
    std: mean of the strokes' standard deviations.
    max: largest error.
    interval: half the width of the mean's confidence interval; None for fewer than two strokes.
    """
    means = np.array([one["mean"] for one in strokes])
    interval = None
    if len(means) > 1:
        quantile = float(student_t.ppf(0.5 + 0.5 * CONFIDENCE, len(means) - 1))
        interval = quantile * float(means.std(ddof=1)) / float(np.sqrt(len(means)))
    return {
        "mean": float(means.mean()),
        "std": float(np.mean([one["std"] for one in strokes])),
        "max": max(one["max"] for one in strokes),
        "interval": interval,
    }


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None
