"""Define the configurations of the graph that `flexsheet chart system` compares."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from flexsheet.launch.experiments import ExperimentError
from flexsheet.launch.plans.documents import did_you_mean, edit_yaml
from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.launch.running.precompute import (
    precompute_deflection_shapes,
    precompute_force_table,
    precompute_soft_body,
)
from flexsheet.messages.methods import Methods, SoftBodyChoice
from flexsheet.messages.scene import Scene
from flexsheet.nodes.fem_solver.benchmarks import LINEAR_DEPTH_M
from flexsheet.nodes.models.sheet.force_models import ScaledSheetModel, SheetPush
from flexsheet.nodes.planner.sheet_force import make_rubber
from flexsheet.nodes.renderer.benchmarks import is_in_range
from flexsheet.nodes.renderer.sheet_mesh import MAX_TRIANGLES_DEPTH_M

NODE_PARAMETERS: Mapping[str, tuple[str, str]] = {
    "marker": ("triangulator", "marker"),
    "tracking": ("triangulator", "tracking"),
    "sheet_force": ("planner", "sheet_force"),
    "sheet_shape": ("renderer", "sheet_shape"),
    "correction": ("renderer", "correction"),
    "compliance": ("planner", "compliance_mode"),
}
"""For each key of `Methods`, the node type and the node parameter that select the method."""

NODE_DEFAULTS = Methods(
    marker="subpixel_fit",
    tracking="adaptive",
    sheet_force="scaled",
    sheet_shape="reduced_order",
    correction="two_pass",
    soft_body=SoftBodyChoice(method="linear", skin_spacing_m=0.003),
)
"""The methods that the nodes use if the scene does not choose methods."""

PAPER = Methods(
    marker="moments",
    tracking="none",
    sheet_force="scaled",
    sheet_shape="four_triangles",
    correction="four_triangles",
    soft_body=SoftBodyChoice(method="linear", skin_spacing_m=0.0045),
    compliance="stiffness",
)
"""The methods of Furukawa et al. 2007, sections III and IV. There is no tracking filter. The soft
body is linear FEM, and the sheet is drawn as four triangles. Stiffness is rendered only by the
stretch of the sheet."""

PAPER_PLANNER = {"prediction_horizon_s": 0.0}
"""The parameters of the planner for the methods of Furukawa et al. 2007, which do not compensate
the delay (section V-C)."""

FINEST = NODE_DEFAULTS.model_copy(
    update={
        "sheet_force": "table",
        "soft_body": SoftBodyChoice(method="nonlinear_table", skin_spacing_m=0.0045),
    }
)


@dataclass(frozen=True, slots=True)
class Configuration:
    """A choice of methods for all nodes, with values of further planner parameters.

    planner: values of the planner parameters, by parameter name.
    """

    name: str
    methods: Methods
    planner: Mapping[str, float] = field(default_factory=dict)

    def settings(self, graph: ResolvedGraph) -> list[str]:
        """Return the settings "node.parameter=value" that apply this configuration to a graph."""
        # Tables are not computed in the background, which would disturb the measurement.
        chosen = [("fem_solver", "compute_table=false")]
        chosen += [("planner", f"{key}={value}") for key, value in self.planner.items()]
        for key, (node_type, parameter) in NODE_PARAMETERS.items():
            method = getattr(self.methods, key)
            if method is not None:
                chosen.append((node_type, f"{parameter}={method}"))
        if self.methods.soft_body is not None:
            body = self.methods.soft_body
            chosen.append(("fem_solver", f"method={body.method}"))
            chosen.append(("fem_solver", f"skin_spacing_m={body.skin_spacing_m}"))
        return [
            f"{node.name}.{text}"
            for node_type, text in chosen
            for node in graph.nodes_of_type(node_type)
        ]

    def prepare(self, scene: Scene, progress: Callable[[str], None]) -> None:
        """Compute and cache the tables that the methods need.

        If a table were missing, a node would use another method, and the wrong method would be
        measured. The computation of the table of a soft body takes minutes.
        """
        if self.methods.sheet_shape == "reduced_order" and scene.projector is not None:
            precompute_deflection_shapes(scene, None, progress)
        if self.methods.sheet_force == "table":
            precompute_force_table(scene, None, progress)
        body = self.methods.soft_body
        if body is not None and body.method == "nonlinear_table" and scene.object.material:
            precompute_soft_body(scene, body.skin_spacing_m, None, None, progress)

    def describe(self) -> dict[str, Any]:
        """Return the methods and the planner's parameters for the description of a trial."""
        return {"methods": self.methods.model_dump(mode="json"), "planner": dict(self.planner)}


def choose_cheapest(scene: Scene) -> Methods:
    """Return the cheapest method of each family that is valid in the scene's whole working range.

    Errors are not considered. If no method of a method family is valid in the whole range, the
    method with the largest valid range is returned.
    """
    depth_m, tilt_deg = scene.working_range.push_depth_m, np.degrees(scene.working_range.tilt_rad)
    stretch = 0.5 * (scene.sheet.min_stretch_ratio + scene.sheet.max_stretch_ratio)
    rubber = make_rubber(scene.sheet)
    is_scaled = not ScaledSheetModel(rubber).invalid_reason(
        SheetPush(stretch, scene.finger.radius_m), depth_m
    )
    corrections = ("one_plane", "four_triangles", "two_pass")
    limits = {"tilt_deg": min(float(tilt_deg), 50.0), "push_mm": 1e3 * depth_m}
    correction = next((one for one in corrections if is_in_range(one, **limits)), "two_pass")
    is_flat = depth_m <= MAX_TRIANGLES_DEPTH_M
    return Methods.model_validate(
        {
            "marker": "moments",
            "tracking": "one_euro",
            "sheet_force": "scaled" if is_scaled else "table",
            "sheet_shape": "four_triangles" if is_flat else "reduced_order",
            "correction": correction,
            "soft_body": {"method": "linear", "skin_spacing_m": 0.006}
            if depth_m <= LINEAR_DEPTH_M
            else {"method": "nonlinear_table", "skin_spacing_m": 0.0045},
        }
    )


def choose_tuned(scene: Scene) -> Methods:
    """Return the method that the scene chooses for each family.

    If the scene chooses no method of a family, the default of the nodes is returned.
    """
    chosen = scene.methods.model_dump(exclude_none=True)
    return Methods.model_validate(NODE_DEFAULTS.model_dump() | chosen)


TUNED = "tuned"
NAMES = ("paper", "cheapest in range", "default", TUNED, "most exact")
CONTROL = TUNED
"""The name of the configuration with which others are compared. It runs twice in each block."""

CONTROL_AGAIN = "tuned, again"


def list_configurations(scene: Scene) -> list[Configuration]:
    """Return the configurations that are compared for a scene.

    If the scene chooses no methods, the configurations "tuned" and "default" are equal, and
    "default" is omitted.
    """
    tuned = choose_tuned(scene)
    found = [
        Configuration("paper", PAPER, PAPER_PLANNER),
        Configuration("cheapest in range", choose_cheapest(scene)),
        Configuration("default", NODE_DEFAULTS),
        Configuration(TUNED, tuned),
        Configuration("most exact", FINEST),
    ]
    return [one for one in found if one.name != "default" or tuned != NODE_DEFAULTS]


def select_configurations(scene: Scene, names: Collection[str]) -> list[Configuration]:
    """Return the configurations with the given names, and the one with which they are compared.

    If no name is given, all configurations are returned. Raises ExperimentError if a name is
    unknown.
    """
    known = list_configurations(scene)
    for name in names:
        if name not in NAMES:
            raise ExperimentError(f'unknown configuration "{name}"; {did_you_mean(name, NAMES)}')
    return [one for one in known if not names or one.name in {*names, CONTROL}]


def write_launch_file(launch_file: Path, scene_file: Path, target: Path) -> Path:
    """Write a copy of a launch file with another scene, and return its path.

    Relative paths become absolute in the copy, and recording is disabled.
    """
    with edit_yaml(launch_file, target) as launch:
        launch["scene"] = str(scene_file.resolve())
        launch.pop("record", None)
        for spec in launch["nodes"].values():
            given = spec.get("parameters", {})
            for parameter, value in given.items():
                file = launch_file.parent / str(value)
                if isinstance(value, str) and file.is_file():
                    given[parameter] = str(file.resolve())
    return target
