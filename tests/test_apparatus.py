"""Test the apparatus: files, draws from the table of tolerances, and read access."""

from __future__ import annotations

import ast
import json
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from click.testing import Result
from pydantic import BaseModel
from ruamel.yaml import YAML
from typer.testing import CliRunner

from flexsheet.launch.cli import app
from flexsheet.launch.plans.apparatus import format_apparatus, load_apparatus, parse_draw
from flexsheet.launch.plans.documents import BadInputError
from flexsheet.launch.plans.plan import load_graph, load_scene
from flexsheet.messages.apparatus import Apparatus, identify_scene, nominal_apparatus
from flexsheet.messages.scene import Pose, Scene
from flexsheet.messages.topics import TOPICS
from flexsheet.nodes import NODES, NodeRole, node_class
from flexsheet.nodes.node import Input, Node, find_parameters_type, find_ports, find_role
from flexsheet.nodes.twin import tolerance_table
from flexsheet.nodes.twin.tolerance_table import (
    NOT_SIMULATED,
    TRUTH_SECTIONS,
    Profile,
    deviate_apparatus,
    expand_key,
    iterate_paths,
    list_differences,
    load_tolerances,
    sample_apparatus,
    value_at,
)
from flexsheet.nodes.twin.truth import SimulatorParameters, apply_apparatus, check_truth

ROOT = Path(__file__).resolve().parent.parent
DEMO = ROOT / "launch" / "demo.yaml"


class Spy(Node):
    """A node that subscribes to the true parameters, which only the simulator may read."""

    twin__apparatus: Input[Apparatus]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(ROOT / "launch" / "scenes" / "cylinder.yaml")


def all_paths(scene: Scene) -> set[str]:
    values = nominal_apparatus(scene).model_dump(mode="json")
    return {
        path for section in TRUTH_SECTIONS for path in iterate_paths(values[section], f"{section}.")
    }


def values_of(scene: Scene, seed: int, **options: Any) -> dict[str, Any]:
    values = sample_apparatus(scene, seed, **options).model_dump(mode="json")
    return {path: value_at(values, path) for path in all_paths(scene)}


def write(folder: Path, text: str) -> Path:
    path = folder / "apparatus.yaml"
    path.write_text(text)
    return path


def test_the_nominal_apparatus_is_the_scene(scene: Scene) -> None:
    for apparatus in (None, Apparatus(scene=scene.name), nominal_apparatus(scene)):
        assert apply_apparatus(scene, apparatus).model_dump_json() == scene.model_dump_json()
    assert not list_differences(nominal_apparatus(scene))


def test_each_field_has_one_row_of_the_table(scene: Scene) -> None:
    rows = [path for row in load_tolerances().values() for path in expand_key(row.key)]
    assert sorted(rows) == sorted(all_paths(scene))
    assert all(row.source for row in load_tolerances().values())
    assert all(row.calibrated_source for row in load_tolerances().values() if row.calibrated)


def test_fields_that_are_not_simulated_are_listed(scene: Scene) -> None:
    assert set(NOT_SIMULATED) == {
        "finger.hand_mass_kg",
        "finger.hand_damping_ratio",
        "finger.hand_stiffness_n_per_m",
    }
    assert set(NOT_SIMULATED) <= all_paths(scene)


@pytest.mark.parametrize("profile", Profile)
@pytest.mark.parametrize("calibrated", [False, True])
def test_draws_are_possible_and_repeatable(
    scene: Scene, profile: Profile, *, calibrated: bool
) -> None:
    for seed in range(10):
        drawn = sample_apparatus(scene, seed, profile=profile, calibrated=calibrated)
        again = sample_apparatus(scene, seed, profile=profile, calibrated=calibrated)
        assert drawn.model_dump_json() == again.model_dump_json()
        assert not check_truth(scene, drawn)
        assert apply_apparatus(scene, drawn).camera.rate_hz > 0.0


def test_seeds_differ(scene: Scene) -> None:
    one, other = values_of(scene, 0), values_of(scene, 1)
    same = {path for path in one if one[path] == other[path]}
    assert same <= {
        "camera.rate_hz",
        "finger.marker_shape",
        "arms.left.controller_period_s",
        "arms.right.controller_period_s",
    }


def test_a_new_row_changes_no_other_value(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    before = values_of(scene, 3)
    fewer = dict(load_tolerances())
    del fewer["camera.position_offset_m"]
    monkeypatch.setattr(tolerance_table, "load_tolerances", lambda: fewer)
    after = values_of(scene, 3)
    assert {path for path in before if before[path] != after[path]} == {"camera.position_offset_m"}


def test_calibration_reduces_the_differences(scene: Scene) -> None:
    for path in ("camera.position_offset_m", "arms.left.base_position_offset_m"):
        rough = np.array([values_of(scene, seed)[path] for seed in range(20)])
        fine = np.array([values_of(scene, seed, calibrated=True)[path] for seed in range(20)])
        assert np.abs(fine).mean() < 0.5 * np.abs(rough).mean()


def test_both_arms_share_their_lag(scene: Scene) -> None:
    for seed in range(10):
        values = values_of(scene, seed)
        lags_s = [values[f"arms.{side}.servo_lag_s"] for side in ("left", "right")]
        assert 0.0 < abs(lags_s[0] - lags_s[1]) <= 5e-3


def test_the_papers_camera_reads_out_for_most_of_a_frame(scene: Scene) -> None:
    rates = set()
    for seed in range(12):
        camera = sample_apparatus(scene, seed, profile=Profile.PAPER).camera
        assert camera.rate_hz is not None
        assert camera.read_out_s == pytest.approx(0.9 / camera.rate_hz)
        rates.add(camera.rate_hz)
    assert rates == {15.0, 30.0, 48.0}


def test_the_mean_and_spread_of_a_row_are_those_of_its_draws() -> None:
    random = np.random.default_rng(12)
    for key, mean, sigma in (
        ("camera.position_offset_m", 0.0, 0.3e-3),
        ("sheet.thickness_ratio", 1.0, 0.06),
        ("camera.stamp_offset_s", 0.0, 10e-3 / np.sqrt(12.0)),
    ):
        given = load_tolerances()[key].of(Profile.MODERN, calibrated=False)
        assert not isinstance(given, tuple)
        draws = np.array([given.draw(random) for _ in range(4000)])
        assert draws.mean() == pytest.approx(mean, abs=0.06 * sigma)
        assert draws.std() == pytest.approx(sigma, rel=0.05)


@pytest.mark.parametrize("key", load_tolerances())
def test_one_row_can_deviate_alone(scene: Scene, key: str) -> None:
    for profile in Profile:
        for sigmas in (-3.0, 1.0):
            given = deviate_apparatus(scene, key, sigmas, profile=profile)
            changed = {path for path, *_ in list_differences(given)}
            assert changed <= set(expand_key(key))
    low, high = (
        value_at(deviate_apparatus(scene, key, sigmas).model_dump(), expand_key(key)[0])
        for sigmas in (-1.0, 1.0)
    )
    assert low == high or low < high


def test_offsets_move_the_true_devices(scene: Scene) -> None:
    given = Apparatus.model_validate(
        {
            "scene": scene.name,
            "camera": {"position_offset_m": [1e-3, 0, 0], "rate_hz": 30.0},
            "arms": {"right": {"base_rotation_offset_rad": [0, 0, 0.01]}},
            "sheet": {"modulus_ratio": 1.1, "clamp_slip_m": [1e-3, 2e-3]},
            "finger": {"radius_offset_m": 1e-3},
            "eyes": {"interocular_offset_m": -1e-3},
            "projector": {"lens": {"focal_ratio": 1.01}},
        }
    )
    true = apply_apparatus(scene, given)

    def moved(one: Pose, other: Pose) -> Any:
        return (one.position_m - other.position_m).tolist()

    assert moved(true.camera.world_from_left, scene.camera.world_from_left) == pytest.approx(
        [1e-3, 0, 0]
    )
    assert true.camera.rate_hz == 30.0
    turned = true.arms.right.world_from_base
    assert moved(turned, scene.arms.right.world_from_base) == [0, 0, 0]
    assert not np.array_equal(turned.rpy_rad, scene.arms.right.world_from_base.rpy_rad)
    assert true.arms.left.model_dump_json() == scene.arms.left.model_dump_json()
    assert true.sheet.young_modulus_pa == pytest.approx(1.1e6)
    assert true.sheet.width_m == pytest.approx(scene.sheet.width_m + 3e-3)
    assert true.finger.radius_m == pytest.approx(0.008)
    assert true.eyes.interocular_m == pytest.approx(0.063)
    assert true.projector.lens.fx_px == pytest.approx(2020.0)


def test_the_truth_stays_when_the_scene_is_calibrated(scene: Scene) -> None:
    drawn = sample_apparatus(scene, 5)
    camera = scene.camera.model_copy(
        update={"world_from_left": Pose(position_m=np.ones(3), rpy_rad=np.zeros(3))}
    )
    corrected = scene.model_copy(update={"camera": camera})
    assert identify_scene(corrected) == identify_scene(scene)
    one, other = apply_apparatus(scene, drawn), apply_apparatus(corrected, drawn)
    assert one.model_dump_json() == other.model_dump_json()


def test_a_file_holds_all_of_a_draw(scene: Scene, tmp_path: Path) -> None:
    drawn = sample_apparatus(scene, 5, profile=Profile.PAPER)
    read = load_apparatus(str(write(tmp_path, format_apparatus(drawn))), scene)
    assert read.model_dump_json() == drawn.model_dump_json()


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("scene: cylinder\nsheeet: {}\n", ('2: sheeet: unknown key "sheeet"', '"sheet"')),
        ("scene: cylinder\nsheet: {modulus: 2}\n", ("sheet.modulus", "modulus_ratio")),
        ("scene: cylinder\nsheet: {modulus_ratio: -2}\n", ("2: sheet.modulus_ratio: -2", "0.1")),
        (
            "scene: cylinder\ncamera: {position_offset_m: [2, 0, 0]}\n",
            ("camera.position_offset_m.0: 2 ", "0.5"),
        ),
        (
            "scene: cylinder\nfinger: {radius_offset_m: -0.01}\n",
            ("2: finger.radius_offset_m: -0.01 makes the finger radius", "more than"),
        ),
        ("scene: cylinder\nfinger: {hand_mass_kg: 1}\n", ("hand_mass_kg", "all three or none")),
        ("scene: cylinder\nfinger: {tremor_width_hz: 30}\n", ("tremor_width_hz", "less than")),
        ("scene: sphere\n", ('1: scene: the file belongs to scene "sphere"', "apparatus seed:N")),
        (
            "scene: cylinder\nscene_id: '0'\n",
            ('2: scene_id: the file belongs to scene_id "0"', "apparatus seed:N"),
        ),
        ("sheet: {}\n", ('"scene" is missing', 'add "scene"')),
    ],
)
def test_a_bad_file_is_refused(
    scene: Scene, tmp_path: Path, text: str, wanted: tuple[str, str]
) -> None:
    path = write(tmp_path, text)
    with pytest.raises(BadInputError) as caught:
        load_apparatus(str(path), scene)
    assert str(path) in str(caught.value)
    assert all(part in str(caught.value) for part in wanted)


def test_draws_are_parsed() -> None:
    draw = parse_draw("seed:7,paper,calibrated")
    assert draw is not None
    assert (draw.seed, draw.profile, draw.calibrated) == (7, Profile.PAPER, True)
    assert parse_draw("lab.yaml") is None
    for text in ("seed:", "seed:-1", "seed:1,old", "seed:1,paper,modern", "seed:1,paper,paper"):
        with pytest.raises(BadInputError, match="seed:N"):
            parse_draw(text)


def test_only_simulator_nodes_get_the_apparatus() -> None:
    plain, given = load_graph(DEMO), load_graph(DEMO, apparatus="seed:3")
    for name, node in given.nodes.items():
        simulated = issubclass(find_parameters_type(node_class(node.type)), SimulatorParameters)
        assert simulated == name.startswith("twin_")
        if simulated:
            assert node.parameters["apparatus"] == given.apparatus
        else:
            assert node.parameters == plain.nodes[name].parameters
    assert plain.apparatus is None
    assert "twin/apparatus" not in plain.writers
    assert [one.name for one in given.writers["twin/apparatus"]] == ["launch"]
    assert given.hash != plain.hash
    assert given.apparatus_message() is not None


def test_bags_carry_the_apparatus(tmp_path: Path) -> None:
    plan = load_graph(DEMO, apparatus="seed:3", record=tmp_path / "a.mcap")
    topics = {port.topic for port in plan.nodes["recorder"].inputs}
    assert "twin/apparatus" in topics


def models_in(annotation: Any) -> set[Any]:
    """Return all models in the type of a field, at any depth."""
    found = set()
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        found.add(annotation)
        for field in annotation.model_fields.values():
            found |= models_in(field.annotation)
    for part in get_args(annotation):
        found |= models_in(part)
    return found


@pytest.mark.parametrize("name", NODES)
def test_no_other_node_can_read_the_apparatus(name: str) -> None:
    class_ = node_class(name)
    if class_.__module__.startswith("flexsheet.nodes.twin."):
        assert issubclass(find_parameters_type(class_), SimulatorParameters)
        return
    assert Apparatus not in models_in(find_parameters_type(class_))
    assert all(port.message is not Apparatus for port in find_ports(class_).values())
    if find_role(class_) is not NodeRole.RECORDER:
        parameters = find_parameters_type(class_)
        required = {one for one, field in parameters.model_fields.items() if field.is_required()}
        if not required:
            further = class_.further_inputs(parameters(), list(TOPICS.values()))
            assert "twin/apparatus" not in further


def test_no_other_node_imports_the_apparatus() -> None:
    for path in (ROOT / "nodes").rglob("*.py"):
        if path.relative_to(ROOT).parts[1] == "twin":
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            names = (
                [one.name for one in node.names]
                if isinstance(node, ast.Import)
                else [node.module or "", *(f"{node.module}.{one.name}" for one in node.names)]
                if isinstance(node, ast.ImportFrom)
                else []
            )
            for one in names:
                assert "messages.apparatus" not in one, path
                assert not one.startswith("flexsheet.nodes.twin"), path


def test_a_node_that_asks_for_the_topic_is_refused(tmp_path: Path) -> None:
    launch_file = tmp_path / "spy.yaml"
    spied = {"type": "tests.test_apparatus:Spy"}
    yaml = YAML()
    tree = yaml.load(DEMO.read_text())
    tree["scene"] = str(ROOT / "launch" / "scenes" / "cylinder.yaml")
    tree["nodes"]["triangulator"]["parameters"] = {}
    tree["nodes"]["spy"] = spied
    with launch_file.open("w") as file:
        yaml.dump(tree, file)
    with pytest.raises(BadInputError, match="would read the ground truth"):
        load_graph(launch_file, apparatus="seed:1")


def test_graphs_without_a_simulator_refuse_an_apparatus(tmp_path: Path) -> None:
    launch_file = tmp_path / "plain.yaml"
    scene_file = ROOT / "launch" / "scenes" / "cylinder.yaml"
    text = f"scene: {scene_file}\nnodes: {{planner: {{type: planner}}}}\n"
    launch_file.write_text(text + "external_topics: [fingertip, soft_body]\n")
    with pytest.raises(BadInputError, match="no simulator node"):
        load_graph(launch_file, apparatus="seed:1")
    with pytest.raises(BadInputError, match="use the option --apparatus"):
        load_graph(DEMO, settings=["twin_eye.apparatus={scene: cylinder}"])


def run(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["apparatus", *arguments])


def test_the_command_samples_and_shows(tmp_path: Path) -> None:
    file = tmp_path / "a.yaml"
    made = run("seed:4,paper", "-o", str(file), "--json")
    assert made.exit_code == 0, made.output
    assert json.loads(made.stdout)["origin"] == "seed:4,paper"
    shown = run(str(file), "--json")
    rows = {row["parameter"]: row for row in json.loads(shown.stdout)["differences"]}
    assert rows["camera.rate_hz"]["unit"] == "Hz"
    assert rows["finger.hand_mass_kg"]["simulated"] is False
    assert rows["sheet.hysteresis_ratio"]["simulated"] is True
    assert rows["arms.left.servo_lag_s"]["simulated"] is True
    assert "sheet.modulus_ratio" in run("seed:4").stdout
