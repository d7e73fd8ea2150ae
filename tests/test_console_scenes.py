"""Test scenes that are selected, changed by sliders, and restored."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.base import Message
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import (
    Recording,
)
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from flexsheet.nodes.arm_bridge.limiter import check_sheet
from flexsheet.nodes.console import scenes
from flexsheet.nodes.console.controller import (
    SETTLE_S,
    ConsoleController,
    SceneController,
)
from flexsheet.nodes.console.finger import FingerController
from flexsheet.nodes.console.picking import SurfacePicker
from tests.console_parts import ROOT
from tests.plans import scene_with
from tests.scenes import load_cylinder

Floats = NDArray[np.float64]
SCENES = ROOT / "launch" / "scenes"


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_cylinder()


SOLIDS: list[dict[str, Any]] = [
    {"shape": "cylinder", "radius_m": 0.05, "length_m": 0.2},
    {"shape": "sphere", "radius_m": 0.05},
    {"shape": "ellipsoid", "semi_axes_m": [0.05, 0.04, 0.03]},
    {"shape": "rounded_box", "size_m": [0.1, 0.08, 0.06], "edge_radius_m": 0.01},
    {"shape": "plane", "width_m": 0.2, "height_m": 0.2},
]


@pytest.mark.parametrize("geometry", SOLIDS, ids=lambda one: str(one["shape"]))
def test_a_larger_object_keeps_its_front(geometry: dict[str, Any]) -> None:
    first = scene_with(geometry, (0.0, 0.0, -0.05), (0.2, 0.0, 0.0))
    grown = scenes.edit_scene(first, young_modulus_pa=9e3, stretch_ratio=1.05, size_ratio=1.3)
    assert grown.object.material.young_modulus_pa == 9e3
    assert grown.sheet.min_stretch_ratio == 1.05

    def front(scene: Scene) -> float:
        shape = SurfacePicker(scene)
        seen = shape.pick(np.array([0.0, 0.0, 0.5]), np.array([0.0, 0.0, -1.0]), 0.0)
        return float(seen[2])

    if geometry["shape"] in ("sphere", "plane"):
        assert front(grown) == pytest.approx(front(first), abs=3e-4)
    assert grown.object.world_from_object.position_m[2] <= -0.05


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("young_modulus_pa", -1.0),
        ("young_modulus_pa", np.nan),
        ("stretch_ratio", 0.9),
        ("stretch_ratio", 1.09),
        ("size_ratio", 0.0),
        ("size_ratio", np.inf),
    ],
)
def test_values_that_make_no_scene_are_rejected(scene: Scene, name: str, value: float) -> None:
    good = {"young_modulus_pa": 4e3, "stretch_ratio": 1.02, "size_ratio": 1.0}
    with pytest.raises(scenes.SceneChoiceError):
        scenes.edit_scene(scene, **good | {name: value})


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.yaml")), ids=lambda path: path.stem)
def test_the_tension_ends_where_the_arms_would_stop(path: Path) -> None:
    """At more than 8 % of stretch, the edge force would exceed the limit of the arms."""
    scene = load_scene(path)
    limit = scenes.max_stretch_ratio(scene)
    tight = scenes.edit_scene(
        scene, young_modulus_pa=4e3, stretch_ratio=limit, size_ratio=1.0
    ).sheet
    assert tight.max_stretch_ratio == scene.sheet.max_stretch_ratio
    assert tight.min_stretch_ratio == limit <= tight.max_stretch_ratio
    left, right = np.eye(4), np.eye(4)
    left[0, 3], right[0, 3] = np.array([-0.5, 0.5]) * limit * tight.width_m
    limits = ArmGeometry(scene, "left").sheet_limits
    assert check_sheet(left, right, left=True, limits=limits) is None


async def test_scenes_are_sent_once_a_slider_rests(scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "other.json").write_text(scene.model_dump_json())
    sent: list[Message] = []
    controller = SceneController(sent.append, tmp_path, scene)
    controller.slide(10.0, young_modulus_pa=5e3)
    controller.slide(10.3, young_modulus_pa=6e3)
    assert not controller.apply_sliders(10.3 + 0.9 * SETTLE_S)
    assert controller.apply_sliders(10.3 + SETTLE_S)
    assert not controller.apply_sliders(20.0)
    assert [one.object.material.young_modulus_pa for one in sent if isinstance(one, Scene)] == [6e3]
    controller.choose("other")
    assert controller.sliders.young_modulus_pa == scene.object.material.young_modulus_pa
    with pytest.raises(scenes.SceneChoiceError, match='unknown scene "none"; choose one of: other'):
        controller.choose("none")
    controller.slide(30.0, size_ratio=-1.0)
    with pytest.raises(scenes.SceneChoiceError):
        controller.apply_sliders(31.0)
    assert len(sent) == 2


def test_a_restarted_console_restores_its_state(scene: Scene, tmp_path: Path) -> None:
    plan_file = tmp_path / "plan.json"
    plan_file.write_text(f'{{"scene": {scene.model_dump_json()}}}')
    rigid = scene.object.model_copy(update={"material": None})
    (tmp_path / "scenes").mkdir()
    for name, solid in (("other", scene.object), ("rigid", rigid)):
        other = scene.model_copy(update={"name": name, "object": solid})
        (tmp_path / "scenes" / f"{name}.json").write_text(other.model_dump_json())

    def controller() -> tuple[ConsoleController, list[Message]]:
        sent: list[Message] = []
        made = ConsoleController(sent.append, plan_file, FingerController(sent.append))
        made.begin()
        made.finger.use(SurfacePicker(made.scenes.scene))
        made.finger.advance(1.0, None)
        return made, sent

    first, sent = controller()
    assert [one.name for one in sent if isinstance(one, Scene)] == [scene.name]
    first.scenes.choose("other")
    first.scenes.slide(1.0, young_modulus_pa=9e3, size_ratio=1.2)
    first.scenes.apply_sliders(2.0)
    first.record(True)
    again, sent = controller()
    taken_up, recording = sent
    assert isinstance(taken_up, Scene)
    assert taken_up.model_dump_json() == first.scenes.scene.model_dump_json()
    assert (again.scenes.sliders.young_modulus_pa, again.scenes.sliders.size_ratio) == (9e3, 1.0)
    assert recording == Recording(running=True)
    again.record(False)
    again.scenes.choose("rigid")
    third, sent = controller()
    assert [type(message) for message in sent] == [Scene], "nothing is recorded or moved"
    assert third.scenes.sliders.young_modulus_pa is None
