"""Test that every number in scenes, launch files and node parameters has limits."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError
from ruamel.yaml import YAML

from flexsheet.launch.plans.documents import BadInputError, read_document, validate
from flexsheet.launch.plans.launch_file import LaunchFile
from flexsheet.launch.plans.plan import load_graph, load_scene
from flexsheet.messages.calibration import StereoCalibration
from flexsheet.messages.limits import LimitedModel, find_max_magnitude
from flexsheet.messages.scene import Scene
from flexsheet.nodes import NODES, node_class
from flexsheet.nodes.node import NodeParameters, find_parameters_type
from tests.examples import examples

ROOT = Path(__file__).resolve().parent.parent
SCENES = sorted((ROOT / "launch" / "scenes").glob("*.yaml"))
Key = tuple[Any, ...]


def numbers_in(value: Any, key: Key = ()) -> Iterator[Key]:
    """Return the keys of all numbers in nested lists and dictionaries."""
    match value:
        case dict():
            for name, one in value.items():
                yield from numbers_in(one, (*key, name))
        case list():
            for number, one in enumerate(value):
                yield from numbers_in(one, (*key, number))
        case bool():
            return
        case int() | float():
            yield key


def replaced(values: Any, key: Key, value: object) -> Any:
    result = copy.deepcopy(values)
    target = result
    for part in key[:-1]:
        target = target[part]
    target[key[-1]] = value
    return result


SCENE_VALUES = {path.stem: YAML(typ="safe").load(path.read_text()) for path in SCENES}
SCENE_NUMBERS = [(name, key) for name, one in SCENE_VALUES.items() for key in numbers_in(one)]
PARAMETERS: dict[str, type[NodeParameters]] = {
    name: find_parameters_type(node_class(name)) for name in NODES
}
PARAMETER_NUMBERS = [
    (name, field)
    for name, model in PARAMETERS.items()
    for field, schema in model.model_json_schema()["properties"].items()
    if {int, float}
    & {model.model_fields[field].annotation, *get_args(model.model_fields[field].annotation)}
    or any(word in str(schema.get("anyOf", [])) for word in ("number", "integer"))
]

ABSURD = st.one_of(
    st.sampled_from([math.nan, math.inf, -math.inf, 1e300, -1e300, 1e308, 2e16, -2e19, 2**64]),
    st.floats(min_value=1e20),
    st.floats(max_value=-1e20),
)
UNUSUAL = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
quick = settings(max_examples=60, suppress_health_check=UNUSUAL)


@settings(examples(12), suppress_health_check=UNUSUAL)
@given(where=st.sampled_from(SCENE_NUMBERS), value=ABSURD)
def test_an_absurd_number_in_a_scene_is_rejected_by_its_key(
    tmp_path: Path, where: tuple[str, Key], value: float
) -> None:
    name, key = where
    file = tmp_path / "scene.yaml"
    (tmp_path / "organ.obj").write_bytes((ROOT / "launch/scenes/organ.obj").read_bytes())
    with file.open("w") as out:
        YAML().dump(replaced(SCENE_VALUES[name], key, value), out)
    with pytest.raises(BadInputError) as refused:
        load_scene(file)
    # A number in an array is named by the array.
    field = next(part for part in reversed(key) if isinstance(part, str))
    assert f".{field}" in str(refused.value)
    assert f"{file}:" in str(refused.value)


@quick
@given(where=st.sampled_from(PARAMETER_NUMBERS), value=ABSURD)
def test_an_absurd_parameter_is_rejected(where: tuple[str, str], value: float) -> None:
    node, field = where
    with pytest.raises(ValidationError) as refused:
        PARAMETERS[node].model_validate({field: value})
    assert field in {error["loc"][0] for error in refused.value.errors()}


@quick
@given(
    where=st.sampled_from(SCENE_NUMBERS),
    value=st.floats(min_value=-1e-12, max_value=1e-12, exclude_min=True, exclude_max=True),
)
def test_a_tiny_number_is_rejected_or_is_a_coordinate(where: tuple[str, Key], value: float) -> None:
    """A positive number below the resolution of devices is rejected."""
    name, key = where
    if name == "organ":
        return
    try:
        scene = Scene.model_validate(replaced(SCENE_VALUES[name], key, value))
    except ValidationError:
        return
    kept: Any = scene
    for part in key:
        kept = kept[part] if isinstance(part, int) else getattr(kept, part)
    zero_allowed = replaced(SCENE_VALUES[name], key, 0.0)
    Scene.model_validate(zero_allowed)
    assert float(np.asarray(kept)) == value


@pytest.mark.parametrize(
    ("key", "value", "printed"),
    [
        (("object", "geometry", "radius_m"), 1e300, "object.geometry.radius_m"),
        (("object", "geometry", "radius_m"), 4.0, "4.0 is invalid; give at most 2 m"),
        (("object", "geometry", "radius_m"), 45.0, "give at most 2 m; 45 mm are 0.045 m"),
        (("working_range", "push_depth_m"), 0.2, "push_depth_m: 0.2 m is more than the size of"),
        (("tolerances", "latency_s"), 35.0, "give at most 10 s; 35 ms are 0.035 s"),
        (("sheet", "max_stretch_ratio"), 8.0, "sheet.max_stretch_ratio: 8.0 is invalid; give at"),
        (("sheet", "young_modulus_pa"), 3e9, "sheet.min_stretch_ratio: 1.02 needs "),
        (("object", "geometry", "radius_m"), -0.1, "radius_m: -0.1 is invalid; "),
        (("projector", "width_px"), 2_000_000_000, "projector.width_px"),
        (("arms", "max_tool_speed_m_per_s"), 1e9, "arms.max_tool_speed_m_per_s"),
        (("camera", "right_from_left", 3, 3), 0.0, "the last row"),
        (("camera", "right_from_left", 0, 0), 1.1, "must be a rotation"),
        (("camera", "right_from_left", 0, 0), -1.0, "reflection"),
        (
            ("object", "material", "young_modulus_pa"),
            4.0,
            "Pa, not 4; 4 kPa are 4000 Pa",
        ),
        (("working_range", "tilt_rad"), 30.0, "30° are 0.5236 rad"),
    ],
)
def test_what_was_accepted_once(tmp_path: Path, key: Key, value: float, printed: str) -> None:
    scene = tmp_path / "scene.yaml"
    with scene.open("w") as out:
        YAML().dump(replaced(SCENE_VALUES["cylinder"], key, value), out)
    graph = {"scene": "scene.yaml", "nodes": {"arms": {"type": "twin_arms"}}}
    (tmp_path / "graph.yaml").write_text(json.dumps(graph))
    with pytest.raises(BadInputError, match=r"scene\.yaml:[0-9]+: ") as refused:
        load_graph(tmp_path / "graph.yaml")
    assert printed in str(refused.value)


def test_an_absurd_rate_in_a_launch_file_is_rejected(tmp_path: Path) -> None:
    file = tmp_path / "graph.yaml"
    file.write_text("nodes:\n  arms:\n    type: twin_arms\n    parameters: {rate_hz: 1.0e+308}\n")
    printed = (
        r"graph.yaml:4: nodes.arms.parameters.rate_hz: 1e\+308 is invalid; give at most 10000 Hz"
    )
    with pytest.raises(BadInputError, match=printed):
        load_graph(file)
    file.write_text("nodes:\n  arms:\n    type: twin_arms\n    start_deadline_s: 1.0e+300\n")
    with pytest.raises(BadInputError, match=r"start_deadline_s: 1e\+300 is invalid"):
        validate(LaunchFile, read_document(file))


def models_below(base: type[BaseModel]) -> Iterator[type[BaseModel]]:
    for model in base.__subclasses__():
        yield model
        yield from models_below(model)


def test_what_files_hold_is_limited() -> None:
    limited = set(models_below(LimitedModel))
    assert {LaunchFile, StereoCalibration, *PARAMETERS.values()} <= limited
    for name, field in Scene.model_fields.items():
        if isinstance(field.annotation, type) and name not in ("name", "methods"):
            assert field.annotation in limited, name


def test_units_have_their_limits() -> None:
    assert find_max_magnitude("position_m") == 10.0
    assert find_max_magnitude("radius_m") == 2.0
    assert find_max_magnitude("speed_m_per_s") == 10.0
    assert find_max_magnitude("max_tool_speed_m_per_s") == 2.2
    assert find_max_magnitude("mark_max_area_px") > find_max_magnitude("width_px")
