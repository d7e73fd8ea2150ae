"""Test which nodes of a launch file are left out as not needed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from ruamel.yaml import YAML

from flexsheet.launch.plans.needed_nodes import REASON_TEXTS
from flexsheet.launch.plans.plan import load_graph, load_scene
from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.messages.scene import MissingPartError, Scene, require_material, require_projector
from flexsheet.messages.types import NodeOmission, SoftBody
from flexsheet.nodes import OmissionReason
from flexsheet.nodes.planner.compliance_controller import ComplianceController
from flexsheet.nodes.planner.parameters import PlannerParameters
from flexsheet.nodes.planner.sheet_force import make_force_model

LAUNCH = Path(__file__).resolve().parent.parent / "launch"
DEMO = LAUNCH / "demo.yaml"


def omitted(plan: ResolvedGraph) -> dict[str, OmissionReason]:
    return {one.name: one.reason for one in plan.omitted}


def change_demo(folder: Path, scene: str | None = None, **changes: Any) -> Path:
    """Write the demo's launch file with another scene, and with other keys of nodes."""
    values = YAML(typ="safe").load(DEMO)
    values["scene"] = str(LAUNCH / "scenes" / (scene or "cylinder.yaml"))
    calibration = values["nodes"]["triangulator"]["parameters"]
    calibration["calibration"] = str(LAUNCH / calibration["calibration"])
    for name, keys in changes.items():
        values["nodes"].setdefault(name, {}).update(keys)
    path = folder / "changed.yaml"
    path.write_text(json.dumps(values))  # JSON is YAML
    return path


def test_the_simulated_eye_starts_only_for_a_reader(tmp_path: Path) -> None:
    plan = load_graph(DEMO)
    assert omitted(plan) == {"twin_eye": OmissionReason.NO_READER}
    assert "twin_eye" not in plan.nodes
    assert "twin/eye" not in plan.writers
    bag = tmp_path / "a.mcap"
    assert "twin_eye" in omitted(load_graph(DEMO, record=bag)), "a recorder asks for nothing"
    asked = load_graph(DEMO, record=bag, settings=["recorder.include=[twin/eye]"])
    for plan in (asked, load_graph(DEMO, needed=["twin/eye"]), load_graph(DEMO, console=True)):
        assert omitted(plan) == {}
    always = load_graph(change_demo(tmp_path, twin_eye={"always": True}))
    assert omitted(always) == {}


def test_a_scene_that_says_less_starts_less(tmp_path: Path) -> None:
    path = change_demo(tmp_path, "rigid-plane.yaml")
    plan = load_graph(path, needed=["twin/eye"])
    assert omitted(plan) == {
        "fem_solver": OmissionReason.RIGID_OBJECT,
        "renderer": OmissionReason.NO_IMAGE,
        "twin_eye": OmissionReason.NO_IMAGE,
    }
    assert not plan.writers.keys() & {"skin", "soft_body", "frame", "twin/eye"}
    [body] = [one for one in plan.nodes["planner"].inputs if one.topic == "soft_body"]
    assert body.endpoints == ()
    # A console can change to a scene that says more.
    assert omitted(load_graph(path, console=True)) == {}


def test_a_node_whose_inputs_nobody_writes_is_left_out(tmp_path: Path) -> None:
    values = YAML(typ="safe").load(change_demo(tmp_path))
    del values["nodes"]["renderer"]
    path = tmp_path / "no-renderer.yaml"
    path.write_text(json.dumps(values))
    plan = load_graph(path, needed=["twin/eye"])
    assert omitted(plan) == {"twin_eye": OmissionReason.NO_WRITER}


def test_every_reason_has_a_text_and_a_place_in_the_message() -> None:
    assert set(OmissionReason) == REASON_TEXTS.keys()
    field = NodeOmission.model_fields["reason"].annotation
    assert set(get_args(field)) == {one.value for one in OmissionReason}


CHOSEN_BY_SCENES = {"sheet_shape", "correction", "compliance_mode", "method", "skin_spacing_m"}


def test_shipped_launch_files_do_not_override_what_a_scene_chooses() -> None:
    for path in LAUNCH.glob("*.yaml"):
        for name, node in YAML(typ="safe").load(path)["nodes"].items():
            chosen = CHOSEN_BY_SCENES & set(node.get("parameters", {}))
            assert not chosen, f"{path.name}: {name}"


def rigid() -> Scene:
    return load_scene(LAUNCH / "scenes" / "rigid-plane.yaml")


def test_a_rigid_object_is_presented_by_a_constant_stretch() -> None:
    scene = rigid()
    mode = PlannerParameters().choose_compliance(scene)
    controller = ComplianceController(scene, make_force_model(scene.sheet), mode)
    curve = np.column_stack([np.linspace(0.0, 0.01, 8), np.linspace(0.0, 2.0, 8)])
    body = SoftBody.model_construct(stiffness_n_per_m=200.0, force_curve=curve)
    controller.update(body, in_contact=False)
    assert mode == "constant_stretch"
    assert controller.stretch_ratio == scene.sheet.min_stretch_ratio
    assert controller.normal_offset(0.01, (0.0, 0.0)) == (0.0, 0.0)


def test_missing_parts_are_named() -> None:
    for require, part in ((require_material, "material"), (require_projector, "projector")):
        with pytest.raises(MissingPartError, match=f"rigid-plane.*{part}` is missing"):
            require(rigid())
    values = load_scene(LAUNCH / "scenes" / "plane.yaml").model_dump()
    values["object"]["support"] = None
    with pytest.raises(ValueError, match="support is missing"):
        Scene.model_validate(values)


def test_a_solver_whose_fingertip_a_bag_provides_is_started() -> None:
    plan = load_graph(LAUNCH / "replay.yaml")
    assert "fem_solver" in plan.nodes
    assert plan.omitted == ()
