"""Test the selection of methods for a scene: the fastest sufficient one, else the nearest."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML
from typer.testing import CliRunner

from flexsheet.launch.cli import app
from flexsheet.launch.commands.output import NOT_GOOD, CommandError
from flexsheet.launch.methods import tune
from flexsheet.launch.methods.results import describe_load
from flexsheet.launch.methods.tune import (
    Tunable,
    choose,
    evaluate_methods,
    find_tunables,
    insert_choices,
    write_choices,
)
from flexsheet.launch.plans.documents import BadInputError
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.base import Header
from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.methods import Methods, SoftBodyChoice
from flexsheet.messages.scene import Scene
from flexsheet.nodes.fem_solver.soft_body_factory import SoftBodyFactory, choose_method
from flexsheet.nodes.methods import Case, Family, Point, Trial
from flexsheet.nodes.models.sheet.tabulated import TabulatedSheetModel
from flexsheet.nodes.planner.force_table import (
    load_force_model,
    load_or_compute,
    make_table_cache,
)
from flexsheet.nodes.triangulator.benchmarks import MARKER
from flexsheet.nodes.triangulator.node import Triangulator
from flexsheet.nodes.triangulator.parameters import TriangulatorParameters

SCENES = Path(__file__).resolve().parent.parent / "launch" / "scenes"
SCENE = load_scene(SCENES / "cylinder.yaml")


def header_at(source_ns: int) -> Header:
    return Header(1, source_ns, source_ns, "virtual", "test", 0)


CHEAP_FIRST = {"cheap": 1e-5, "middle": 1e-4, "dear": 1e-3}
SETTINGS: dict[str, tune.Setting] = {name: name for name in CHEAP_FIRST}


def point(method: str, error: float, *, depth: int = 1, **more: Any) -> Point:
    case: Case = {"depth_mm": depth}
    took = more.pop("took", CHEAP_FIRST.get(method, 1e-3))
    reported = {"in_range": True} | more
    return Point(method, case, case, median_s=took, p99_s=took, error=error, **reported)


def chosen_of(points: Sequence[Point], *, margin: float = 0.2) -> tune.MethodEvaluation:
    return choose(evaluate_methods(points, SETTINGS, tolerance=1.0, margin=margin))


def test_the_cheapest_that_is_good_enough_everywhere_is_chosen() -> None:
    points = [
        point("cheap", 0.1),
        point("cheap", 0.9, depth=2),  # more than the margin leaves
        point("middle", 0.2),
        point("middle", 0.7, depth=2),
        point("dear", 0.01),
        point("dear", 0.02, depth=2),
    ]
    assert chosen_of(points).method == "middle"
    assert chosen_of(points, margin=0.05).method == "cheap"


def test_a_method_out_of_its_range_is_not_selected_even_if_exact() -> None:
    points = [point("cheap", 0.0, in_range=False), point("dear", 0.5)]
    assert chosen_of(points).method == "dear"


def test_cases_that_the_scene_does_not_ask_for_do_not_count() -> None:
    points = [point("cheap", 0.1), point("cheap", 9.0, depth=50, in_scene=False)]
    assert chosen_of(points).meets


def test_of_methods_with_equal_time_the_more_exact_is_selected() -> None:
    points = [point("cheap", 0.5, took=1.0e-3), point("dear", 0.1, took=1.05e-3)]
    assert chosen_of(points).method == "dear"


@pytest.mark.parametrize("error", [float("nan"), float("inf")])
def test_a_method_without_a_reference_is_not_sufficient(error: float) -> None:
    found = chosen_of([point("cheap", 0.1), point("cheap", error, depth=2)])
    assert not found.meets
    assert found.wrong == ({"depth_mm": 2},)


def test_if_none_is_sufficient_the_nearest_is_selected() -> None:
    points = [
        point("cheap", 3.0),
        point("cheap", 4.0, depth=2),
        point("middle", 0.1),
        point("middle", 1.5, depth=2),
        point("dear", 0.1),
        point("dear", 0.3, depth=2, in_range=False),
    ]
    found = chosen_of(points)
    assert (found.method, found.meets, found.missed) == ("middle", False, 1)


def test_a_method_that_is_meant_for_little_is_no_near_miss() -> None:
    """It is exact in its range, but has no results elsewhere."""
    points = [
        point("cheap", 1.1),
        *(point("cheap", 0.1, depth=depth, in_range=False) for depth in (2, 3)),
        *(point("dear", 1.3, depth=depth) for depth in (1, 2, 3)),
    ]
    found = chosen_of(points)
    assert (found.method, found.missed) == ("dear", 3)


def family(name: str, methods: Sequence[str]) -> Family:
    return Family(name, "mm", "the truth", methods, lambda scene: (), lambda scene: 1.0)


@pytest.fixture
def stand_ins(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Substitute families "quick" and "slow" for a node's own; return the measured ones."""
    there = {"quick": family("made-up", ["cheap"]), "slow": family("made-up", ["cheap", "dear"])}
    monkeypatch.setattr(tune, "load_family", there.__getitem__)
    return []


STAGED = Tunable("marker", ("quick", "slow"), {"cheap": "moments", "dear": "subpixel_fit"})


@pytest.mark.parametrize(
    ("cheap_error", "methods", "chosen"),
    [(0.1, ["cheap"], "cheap"), (2.0, ["cheap", "dear"], "dear")],
)
def test_slow_methods_are_measured_only_if_no_other_is_sufficient(
    stand_ins: list[str],
    cheap_error: float,
    methods: list[str],
    chosen: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def measured(
        asked: Family, scene: Scene, *, select: Callable[[Trial], bool], **_: Any
    ) -> Sequence[Point]:
        errors = {"cheap": cheap_error, "dear": 0.1}
        trials = [Trial(name, {}, lambda: None, lambda _: 0.0, True) for name in asked.methods]
        new = [trial.method for trial in trials if select(trial)]
        stand_ins.extend(new)
        return [point(name, errors[name]) for name in new]

    monkeypatch.setattr(tune, "measure_family", measured)
    (choice,) = tune.tune(SCENE, [STAGED])
    assert stand_ins == methods
    assert choice.chosen.method == chosen
    assert choice.met


def choice_of(points: Sequence[Point], key: str = "marker") -> tune.Choice:
    checked = evaluate_methods(points, SETTINGS, tolerance=1.0)
    return tune.Choice("made-up", key, "mm", 1.0, choose(checked), tuple(checked))


def test_a_sentence_gives_the_reason() -> None:
    met = choice_of([point("cheap", 4.2), point("dear", 0.25)])
    assert met.explain() == (
        "made-up: dear (1 ms), error 0.25, tolerance 1 mm; "
        "cheap is faster (10 µs), but its error is 4.2 mm at depth_mm 1"
    )
    assert met.spare_ratio == pytest.approx(0.75)
    alone = choice_of([point("cheap", 0.1), point("dear", 0.05)])
    assert alone.explain().endswith("no method is faster")


def test_an_insufficient_method_is_reported_with_its_excess() -> None:
    missed = choice_of([point("cheap", 4.2), point("dear", 2.5), point("dear", 0.1, depth=2)])
    assert not missed.met
    assert missed.explain() == (
        "made-up: no method meets the tolerance 1 mm; best is dear (1 ms), outside in 1 of 2 "
        "cases: its error is 2.5 mm at depth_mm 1"
    )


def test_two_passes_go_onto_the_shape_that_was_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    there = {
        "flexsheet.launch.methods.benchmarks:QUICK_SHAPE": family(
            "sheet-shape", ["four_triangles", "reduced_order"]
        ),
        "flexsheet.launch.methods.benchmarks:QUICK_CORRECTION": family(
            "correction", ["one_plane", "two_pass_triangles"]
        ),
        "flexsheet.launch.methods.benchmarks:CORRECTION": family("correction", ["two_pass"]),
    }
    monkeypatch.setattr(tune, "load_family", there.__getitem__)
    errors = {"four_triangles": 0.2, "reduced_order": 0.1, "one_plane": 9.0}

    def measured(asked: Family, scene: Scene, **_: Any) -> Sequence[Point]:
        return [point(name, errors.get(name, 0.3), took=1e-3) for name in asked.methods]

    monkeypatch.setattr(tune, "measure_family", measured)
    tunables = find_tunables(["correction", "sheet-shape"], SCENE)
    shape, correction = tune.tune(SCENE, tunables)
    assert shape.chosen.setting == "reduced_order"  # as quick as the others, and more exact
    assert (correction.chosen.method, correction.chosen.setting) == ("two_pass", "two_pass")
    errors["reduced_order"] = 9.0
    shape, correction = tune.tune(SCENE, tunables)
    assert shape.chosen.setting == "four_triangles"
    assert correction.chosen.method == "two_pass_triangles"
    assert correction.chosen.setting == "two_pass"


def test_method_families_that_a_scene_does_not_use_are_not_tuned() -> None:
    """The plane has neither a material, thus no force, nor a projector, thus no image."""
    plane = load_scene(SCENES / "rigid-plane.yaml")
    assert [one.name for one in find_tunables([], plane)] == ["marker", "tracking"]
    assert len(find_tunables([], SCENE)) == 6
    with pytest.raises(tune.UnknownTunableError, match=r'"correction": it has no `projector`'):
        find_tunables(["correction"], plane)


def test_a_composed_choice_is_explained_without_the_tolerance_of_its_family() -> None:
    choice = replace(choice_of([point("cheap", 4.2), point("dear", 2.5, took=1e-3)]), composed=True)
    assert choice.met
    assert (
        choice.explain()
        == "made-up: dear (1 ms), error 2.5 mm; alternatives: cheap (10 µs, 4.2 mm)"
    )
    text = insert_choices(
        "name: a\n",
        [replace(choice, key="marker")],
        today="2026-01-02",
        machine="a machine",
        commit=None,
        unmet="Not met at the 95 % value: sheet, force.",
    )
    comment = "; a machine.\n# Not met at the 95 % value: sheet, force. See docs/tune.md.\nmethods:"
    assert comment in text
    assert put(text, GOOD).count("#") == 2, "a new comment replaces both lines"
    assert "marker: dear  # 1 ms, error 2.5 mm\n" in text


def put(text: str, *choices: tune.Choice) -> str:
    return insert_choices(text, choices, today="2026-01-02", machine="a machine", commit="0" * 40)


GOOD, BAD = choice_of([point("cheap", 0.1)]), choice_of([point("cheap", 2.0)], "tracking")
FILE = "# mine\nname: one  # a name\n\nnumber: 1.0e+6\n"


def test_choices_are_added_to_a_file_and_all_else_is_left_as_it_was() -> None:
    text = put(FILE, GOOD, BAD)
    assert text.startswith(FILE)
    assert "# Chosen by `flexsheet tune` on 2026-01-02; a machine; code 0000000000.\n" in text
    assert "  marker: cheap  # 10 µs, error 0.1, tolerance 1 mm\n" in text
    assert "  tracking: cheap  # 10 µs, error 2, tolerance 1 mm, not met in 1 of 1 cases\n" in text
    assert YAML(typ="safe").load(text)["methods"] == {"marker": "cheap", "tracking": "cheap"}


def test_choices_are_written_over_and_other_families_stay() -> None:
    text = put(FILE, GOOD, BAD) + "# behind\nlast: 2\n"
    again = put(text, choice_of([point("dear", 0.2)]))
    assert again.count("methods:") == again.count("Chosen by") == 1
    assert YAML(typ="safe").load(again)["methods"] == {"marker": "dear", "tracking": "cheap"}
    assert "not met in 1 of 1 cases" in again  # of the one that was not tuned again
    assert again.startswith(FILE)
    assert again.endswith("# behind\nlast: 2\n")
    assert put(again, choice_of([point("dear", 0.2)])) == again


def test_choices_on_one_line_are_unfolded() -> None:
    text = put(
        "a: 1\nmethods: {marker: x, soft_body: {method: linear, skin_spacing_m: 0.003}}\n", GOOD
    )
    assert YAML(typ="safe").load(text)["methods"] == {
        "marker": "cheap",
        "soft_body": {"method": "linear", "skin_spacing_m": 0.003},
    }


def scene_choice() -> tune.Choice:
    settings: dict[str, tune.Setting] = {"cheap": {"method": "linear", "skin_spacing_m": 0.006}}
    checked = evaluate_methods([point("cheap", 0.1)], settings, tolerance=1.0)
    return tune.Choice("soft-body", "soft_body", "mm", 1.0, checked[0], tuple(checked))


def test_a_scene_file_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    source = tmp_path / "scene.yaml"
    text = (SCENES / "sphere.yaml").read_text().partition("\n# Chosen by")[0]
    source.write_text(text)
    write_choices(source, tmp_path / "copy.yaml", [scene_choice()])
    assert source.read_text() == text
    wanted = SoftBodyChoice(method="linear", skin_spacing_m=0.006)
    assert load_scene(tmp_path / "copy.yaml").methods == Methods(soft_body=wanted)
    with pytest.raises(BadInputError, match="in an existing, writable folder"):
        write_choices(source, tmp_path / "no folder" / "copy.yaml", [scene_choice()])
    with pytest.raises(BadInputError, match="marker") as refused:  # no method's name
        write_choices(source, source, [GOOD])
    assert str(refused.value).startswith(f"{source}: methods.marker: with the choices inserted: ")
    assert source.read_text() == text
    write_choices(source, source, [scene_choice()])
    assert load_scene(source).methods.soft_body == wanted
    assert sorted(path.name for path in tmp_path.iterdir()) == ["copy.yaml", "scene.yaml"]


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("a: 1\r\nb: 2\r\n", "a: 1\r\nb: 2\r\n\r\n# C\r\nmethods:\r\n  marker: cheap\r\n"),
        ("a: 1", "a: 1\n\n# C\nmethods:\n  marker: cheap\n"),
        ("a: 1\n\n\n", "a: 1\n\n\n# C\nmethods:\n  marker: cheap\n"),
        (
            "methods:  # mine\n    # why\n    marker: moments\n"
            "    # of tracking\n    tracking: none"
            "\n\n# behind\nlast: 2",
            "# C\nmethods:  # mine\n    # why\n    marker: cheap\n    # of tracking\n"
            "    tracking: none\n\n# behind\nlast: 2",
        ),
        (
            "methods:\n  soft_body:\n    method: linear\n    skin_spacing_m: 0.003\n",
            "# C\nmethods:\n  soft_body:\n    method: linear\n    skin_spacing_m: 0.003\n"
            "  marker: cheap\n",
        ),
        ("methods: {tracking: null}\n", "# C\nmethods:\n  tracking: null\n  marker: cheap\n"),
        ("methods:\nlast: 2\n", "# C\nmethods:\n  marker: cheap\nlast: 2\n"),
    ],
)
def test_all_else_stays_to_the_byte(before: str, after: str) -> None:
    text = put(before, GOOD)
    text = text.replace(
        "Chosen by `flexsheet tune` on 2026-01-02; a machine; code 0000000000.", "C"
    )
    assert text.replace("  # 10 µs, error 0.1, tolerance 1 mm", "") == after


@pytest.mark.parametrize("quote", ["", "'", '"'])
def test_files_are_named_from_where_a_scene_goes(tmp_path: Path, quote: str) -> None:
    text = (
        f"a: 1\nobject:\n  geometry: {{file: {quote}o.obj{quote}, x: 1}}  # o.obj\n"
        f"  appearance:\n    image_file: {quote}../p.png{quote}\n"
    )
    found = tune.relocate_paths(text, tmp_path / "here" / "a.yaml", tmp_path / "there" / "b.yaml")
    wanted = text.replace(f"{quote}../p.png{quote}", '"../p.png"', 1)
    assert found == wanted.replace(f"{quote}o.obj{quote}", '"../here/o.obj"', 1)
    assert tune.relocate_paths(text, tmp_path / "a.yaml", tmp_path / "b.yaml") == text


def test_a_copy_elsewhere_is_the_same_scene(tmp_path: Path) -> None:
    """The scene is in a read-only folder, except for root."""
    here, there = tmp_path / "here", tmp_path / "far" / "there: b"
    here.mkdir()
    there.mkdir(parents=True)
    text = (SCENES / "palpation.yaml").read_text()
    assert "file: organ.obj" in text
    source, target = here / "scene.yaml", there / "copy.yaml"
    source.write_text(text)
    (here / "organ.obj").write_bytes((SCENES / "organ.obj").read_bytes())
    here.chmod(0o555)
    try:
        tune.check_target(source, target)
        write_choices(source, target, [scene_choice()])
    finally:
        here.chmod(0o755)
    assert 'file: "../../here/organ.obj"' in target.read_text()
    bare = {"methods": Methods()}
    one, other = (load_scene(path).model_copy(update=bare) for path in (source, target))
    assert one.model_dump_json() == other.model_dump_json()
    assert [path.name for path in there.iterdir()] == ["copy.yaml"]
    assert {path.name for path in here.iterdir()} == {"scene.yaml", "organ.obj"}


def test_a_files_name_that_cannot_be_put_in_is_rejected(tmp_path: Path) -> None:
    source = tmp_path / "scene.yaml"
    text = (SCENES / "palpation.yaml").read_text()
    source.write_text(text.replace("organ.obj", r'"orga\x6e.obj"'))
    (tmp_path / "far").mkdir()
    with pytest.raises(BadInputError, match=r"geometry\.file: contains .organ\.obj.*absolute path"):
        tune.check_target(source, tmp_path / "far" / "copy.yaml")


def test_a_link_to_a_scene_stays_a_link(tmp_path: Path) -> None:
    scene, link = tmp_path / "scene.yaml", tmp_path / "link.yaml"
    scene.write_text((SCENES / "sphere.yaml").read_text())
    scene.chmod(0o640)
    link.symlink_to(scene)
    write_choices(link, link, [scene_choice()])
    assert link.is_symlink()
    assert load_scene(scene).methods.soft_body is not None
    assert scene.stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("where", ["no folder/x.yaml", "."])
def test_where_nothing_can_be_written_nothing_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    monkeypatch.setattr(tune, "tune", lambda *_, **__: pytest.fail("measured"))
    outcome = run(SCENES / "sphere.yaml", "--output", tmp_path / where)
    assert isinstance(outcome.exception, BadInputError)
    assert "give --output FILE in an existing, writable folder" in str(outcome.exception)


def run(*arguments: object) -> Any:
    return CliRunner().invoke(app, ["tune", *map(str, arguments)])


def test_a_real_family_is_tuned_by_the_command(tmp_path: Path) -> None:
    out = tmp_path / "tuned.yaml"
    command = [SCENES / "light-touch.yaml", "--family", "marker", "--output", out, "--json"]
    outcome = run(*command)
    assert outcome.exit_code == 0, outcome.output
    result = json.loads(outcome.stdout)
    assert result["met"]
    (only,) = result["families"]
    assert only["chosen"] == "moments"
    assert load_scene(out).methods.marker == only["setting"]


def test_an_insufficient_method_has_a_separate_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    missed = choice_of([point("cheap", 2.0)])
    monkeypatch.setattr(tune, "tune", lambda *_, **__: [missed])
    outcome = run(SCENES / "demanding.yaml", "--dry-run", "--runs", "0")
    assert outcome.exit_code == NOT_GOOD
    assert "no method meets the tolerance 1 mm; best is cheap" in outcome.output
    assert "no file written" in outcome.output


def test_an_unknown_family_is_named_with_the_nearest() -> None:
    outcome = run(SCENES / "cylinder.yaml", "--family", "corection")
    assert isinstance(outcome.exception, CommandError)
    assert 'did you mean "correction"?' in str(outcome.exception)
    assert 'unknown method family "kinematics"' in str(
        run(SCENES / "sphere.yaml", "--family", "kinematics").exception
    )


def test_every_choice_has_a_scene_key() -> None:
    for tunable in tune.TUNABLES:
        for setting in tunable.settings.values():
            assert Methods.model_validate({tunable.key: setting})
    assert {one.key for one in tune.TUNABLES} == set(Methods.model_fields) - {"compliance"}


def test_families_ask_for_the_scenes_own_cases_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flexsheet.nodes.triangulator.benchmarks.MARKER_IMAGES", 1)

    def motions_px(scene: Scene) -> set[object]:
        trials = [trial for trial in MARKER.trials(scene) if trial.in_scene]
        assert all(trial.in_range for trial in trials)
        assert len(trials) == 8, "two motions, two backgrounds and two methods"
        return {trial.case["motion_px"] for trial in trials}

    assert motions_px(SCENE) == {0.0, 0.15}
    working_range = SCENE.working_range.model_copy(
        update={"speed_m_per_s": 4.0 * SCENE.working_range.speed_m_per_s}
    )
    assert motions_px(SCENE.model_copy(update={"working_range": working_range})) == {0.0, 0.6}


@pytest.mark.parametrize(("name", "missed"), [("light-touch", False), ("demanding", True)])
def test_tuned_scenes_report_whether_they_are_sufficient(name: str, missed: bool) -> None:
    """The latencies depend on the computer on which the scene was tuned."""
    text = (SCENES / f"{name}.yaml").read_text()
    methods = Methods.model_validate(YAML(typ="safe").load(text)["methods"])
    assert methods.tracking is not None
    reported = text.partition("95 % value: ")[2].partition(".")[0].split(", ")
    late = {"", "exposure to arm", "exposure to light"}
    assert (bool({*reported} - late) or ", not met in" in text) == missed
    families = dict(methods)
    del families["compliance"]
    assert (None not in families.values()) or missed


def with_methods(**methods: object) -> Scene:
    return SCENE.model_copy(update={"methods": Methods.model_validate(methods)})


async def test_a_node_follows_the_scene_if_set_to_auto() -> None:
    def node(**parameters: Any) -> Triangulator:
        given = TriangulatorParameters(**parameters)
        return Triangulator(given, name="eye", clock=VirtualClock(), send=lambda *_: None)

    follows, set_by_hand = node(), node(tracking="none")
    for each in (follows, set_by_hand):
        await each.setup()
        await each.step("scene", SCENE, header_at(0))
    assert follows.methods == "subpixel_fit, adaptive"
    for each in (follows, set_by_hand):  # another scene, at run time
        changed = with_methods(marker="moments", tracking="one_euro")
        await each.step("scene", changed, header_at(1))
    assert follows.methods == "moments, one_euro"
    assert set_by_hand.methods == "moments, none"


def test_the_soft_body_follows_the_scene_but_begins_no_minutes_of_work(tmp_path: Path) -> None:
    assert choose_method(SCENE_BARE, "auto", "auto") == ("auto", 0.003)
    linear = with_methods(soft_body={"method": "linear", "skin_spacing_m": 0.006})
    assert choose_method(linear, "auto", "auto") == ("linear", 0.006)
    assert choose_method(linear, "nonlinear_table", 0.0045) == ("nonlinear_table", 0.0045)
    table = with_methods(soft_body={"method": "nonlinear_table", "skin_spacing_m": 0.0045})
    assert choose_method(table, "auto", "auto") == ("auto", 0.0045)
    for by_hand_m, effective in (("auto", "0.0045"), (0.003, "0.003")):
        method, spacing_m = choose_method(table, "auto", by_hand_m)
        printed = SoftBodyFactory(spacing_m, tmp_path).pending_note(table, method, [])
        assert printed.endswith(f"--skin-spacing {effective}")
        assert f'the scene "{table.name}" as SCENE' in printed
        dragging = SoftBodyFactory(spacing_m, tmp_path, friction_ratio=0.3)
        assert dragging.pending_note(table, method, []) == "", "there never is a table"
    assert SoftBodyFactory(0.006, tmp_path).pending_note(linear, "auto", []) == ""


SCENE_BARE = SCENE.model_copy(update={"methods": Methods()})


def test_a_missing_force_table_is_replaced_and_reported(tmp_path: Path) -> None:
    sheet = SCENE.sheet.model_copy(update={"thickness_m": 0.0012})
    scene = SCENE.model_copy(update={"sheet": sheet})
    law, reported = load_force_model(scene, "table", tmp_path)
    assert law.name == "scaled"
    assert f'the scene "{scene.name}" as SCENE, run flexsheet precompute SCENE' in reported
    assert load_force_model(scene, "scaled", tmp_path) == (law, "scaled")


@pytest.mark.parametrize("file", sorted(SCENES.glob("*.yaml")), ids=lambda file: file.stem)
def test_the_package_contains_the_force_table_of_each_shipped_scene(
    file: Path, tmp_path: Path
) -> None:
    """If this test fails, run `python -m benchmarks.ship_tables`."""
    scene = load_scene(file)
    law, reported = load_force_model(scene, "table", tmp_path)
    assert (law.name, reported) == ("table", "table")
    stored = load_or_compute(scene, tmp_path)
    assert isinstance(law, TabulatedSheetModel)
    assert np.array_equal(stored.ratios, law.ratios)
    assert make_table_cache(scene).path(tmp_path).is_file()


@pytest.mark.parametrize(("load", "busy"), [(0.2, False), (3.9, False), (4.1, True), (40.0, True)])
def test_a_busy_machine_is_reported(
    monkeypatch: pytest.MonkeyPatch, load: float, busy: bool
) -> None:
    monkeypatch.setattr("os.getloadavg", lambda: (load, 0.0, 0.0))
    monkeypatch.setattr("os.cpu_count", lambda: 8)
    assert (describe_load() is not None) == busy
