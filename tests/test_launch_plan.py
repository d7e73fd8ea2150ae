"""Test the errors of launch files, which name line and remedy before any process starts."""

from __future__ import annotations

from pathlib import Path

import pytest

from flexsheet.launch.plans.documents import BadInputError, did_you_mean, parse_value
from flexsheet.launch.plans.launch_file import is_scene_file
from flexsheet.launch.plans.plan import load_graph, load_scene
from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.launch.plans.routing import FIRST_PORT, PORT_COUNT, _assign_ports

ROOT = Path(__file__).resolve().parent.parent
BEACON = "tests.launch_nodes:Beacon"
LISTENER = "tests.launch_nodes:Listener"
GRAPH = f"""
nodes:
  beacon:
    type: {BEACON}
    parameters:
      rate_hz: 20
  listener:
    type: {LISTENER}
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "graph.yaml"
    path.write_text(text)
    return path


def complaint(folder: Path, text: str, **options: object) -> str:
    with pytest.raises(BadInputError) as caught:
        load_graph(write(folder, text), **options)  # type: ignore[arg-type]  # options of the test
    return str(caught.value)


def test_a_plan_contains_every_endpoint(tmp_path: Path) -> None:
    plan = load_graph(write(tmp_path, GRAPH))
    assert plan.nodes["listener"].inputs[0].endpoints == ("ipc://@run/beacon.twin.finger",)
    assert plan.nodes["beacon"].parameters["rate_hz"] == 20.0
    assert plan.nodes["beacon"].parameters["ready_after_s"] == 0.0
    assert [writer.name for writer in plan.writers["estop"]] == ["listener", "launch", "tools"]


def test_the_same_file_gives_the_same_hash_and_another_value_another(tmp_path: Path) -> None:
    path = write(tmp_path, GRAPH)
    assert load_graph(path).hash == load_graph(path).hash
    assert load_graph(path).hash != load_graph(path, settings=["beacon.rate_hz=21"]).hash


def test_the_hash_does_not_depend_on_the_files_folder(tmp_path: Path) -> None:
    text = GRAPH.replace("rate_hz: 20", "mark: here/mark")
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    one, other = load_graph(write(tmp_path / "a", text)), load_graph(write(tmp_path / "b", text))
    assert one.hash == other.hash
    assert one.nodes["beacon"].parameters["mark"] == str(tmp_path / "a/here/mark")


def test_a_plan_survives_json(tmp_path: Path) -> None:
    plan = load_graph(write(tmp_path, GRAPH))
    assert ResolvedGraph.model_validate_json(plan.model_dump_json()) == plan


def test_tcp_between_hosts_and_ipc_within(tmp_path: Path) -> None:
    text = """
hosts:
  main: {address: 127.0.0.1}
  left: {address: 127.0.0.2}
nodes:
  beacon: {type: "tests.launch_nodes:Beacon", host: left}
  near: {type: "tests.launch_nodes:Listener", host: left}
  far: {type: "tests.launch_nodes:Listener", host: main}
"""
    plan = load_graph(write(tmp_path, text))
    writer = plan.writers["twin/finger"][0]
    assert writer.tcp is not None
    assert writer.tcp.startswith("tcp://127.0.0.2:")
    assert plan.nodes["near"].inputs[0].endpoints == (writer.ipc,)
    assert plan.nodes["far"].inputs[0].endpoints == (writer.tcp,)
    # Nobody elsewhere reads it but a person with a tool.
    status = plan.writer("status", "near")
    assert status is not None
    assert status.endpoint_for("main") == status.tcp
    alone = load_graph(write(tmp_path, GRAPH))
    assert {one.tcp for writers in alone.writers.values() for one in writers} == {None}


def test_ports_stay_in_their_range_and_are_unique_when_hashes_meet() -> None:
    links = [("main", f"node_{i}", "status") for i in range(300)]
    ports = _assign_ports(links)
    assert len(set(ports.values())) == 300
    assert all(FIRST_PORT <= port < FIRST_PORT + PORT_COUNT for port in ports.values())
    assert ports == _assign_ports(links)


@pytest.mark.parametrize(
    ("text", "printed"),
    [
        ("", "the file is empty"),
        ("- a\n", "write a mapping of keys and values"),
        ("nodes: {a: [}\n", "graph.yaml:1: the file is not valid YAML"),
        ("nodes:\n\ta: 1\n", "indent with spaces, not tabs"),
        ("nodes: {}\n", "the graph has no node"),
        ("nodes:\n  a: {type: x}\n  a: {type: y}\n", "duplicate key"),
        (GRAPH + "hots: {}\n", 'graph.yaml:9: hots: unknown key "hots"; did you mean "hosts"?'),
        (
            GRAPH.replace("    parameters", "    paramters"),
            'graph.yaml:5: nodes.beacon.paramters: unknown key "paramters"; '
            'did you mean "parameters"?',
        ),
        (GRAPH.replace(f"type: {BEACON}", "type: planer"), 'did you mean "planner"?'),
        (GRAPH.replace(f"type: {BEACON}", "type: no.such:Thing"), "cannot be imported"),
        (GRAPH.replace(f"type: {BEACON}", "type: '../x:Y'"), 'unknown node type "../x:Y"'),
        (GRAPH.replace(f"type: {BEACON}", "type: ':Y'"), 'unknown node type ":Y"'),
        (GRAPH.replace(f"type: {BEACON}", "type: pathlib:Path"), "is not a node class"),
        (GRAPH.replace(f"    type: {LISTENER}", "    host: main"), '"type" is missing'),
        (
            GRAPH.replace("rate_hz", "rate"),
            'graph.yaml:6: nodes.beacon.parameters.rate: unknown key "rate"; '
            'did you mean "rate_hz"?',
        ),
        (
            GRAPH.replace("rate_hz: 20", "rate_hz: fast"),
            "graph.yaml:6: nodes.beacon.parameters.rate_hz: 'fast' is invalid; "
            "write a number in Hz, without the unit",
        ),
        (GRAPH + "    host: left\n", 'unknown host "left"; choose one of: main'),
        (GRAPH + "hosts: {left: {address: 127.0.0.1}}\n", 'no host is named "main"'),
        (GRAPH + "hosts: {main: {}}\n", 'graph.yaml:9: hosts.main: "address" is missing'),
        (GRAPH + "hosts: {main: {address: left.lab}}\n", '"left.lab" is not an IP address'),
        (GRAPH + "hosts: {main: {address: 0.0.0.0}}\n", "is not the address of a single host"),
        (
            GRAPH + "hosts: {main: {address: 127.0.0.1}, left: {address: 127.0.0.1}}\n",
            'is also the address of host "main"',
        ),
        (
            GRAPH + "    topics: {finger: twin/finger}\n",
            f'"{LISTENER}" has no port "finger"; did you mean "twin__finger"?',
        ),
        (
            GRAPH + "    topics: {twin__finger: twin/fingr}\n",
            'graph.yaml:9: nodes.listener.topics.twin__finger: unknown topic "twin/fingr"; '
            'did you mean "twin/finger"?',
        ),
        (
            GRAPH + "    topics: {twin__finger: twin/arms}\n",
            'topic "twin/arms" has message type TwinArms, but port "twin__finger" requires',
        ),
        (
            GRAPH + f"  second: {{type: '{BEACON}'}}\n",
            'topic "twin/finger" is already written by "beacon"; connect one of the two ports',
        ),
        (
            f"nodes: {{listener: {{type: '{LISTENER}'}}}}\n",
            'no node writes topic "twin/finger"; add a node that writes it',
        ),
        (GRAPH + "scene: nowhere.yaml\n", '"nowhere.yaml" does not exist'),
        (GRAPH + "external_topics: [fingertp]\n", 'did you mean "fingertip"?'),
        (GRAPH + "external_topics: [twin/finger]\n", 'is already written by "beacon"'),
        (GRAPH + f"  tools: {{type: '{LISTENER}'}}\n", '"tools" is reserved'),
        (GRAPH + f"  plan: {{type: '{LISTENER}'}}\n", '"plan" is reserved'),
        (GRAPH + "    restart: {policy: somtimes}\n", "'never', 'on_failure' or 'always'"),
        (GRAPH + "record: {bagg: a.mcap}\n", 'did you mean "bag"?'),
        (GRAPH + "record: {bag: a.mcap, topics: [stereo]}\n", 'no node writes topic "stereo"'),
        (
            GRAPH.replace(f"type: {BEACON}", "type: arm_bridge").replace(
                "rate_hz: 20", "side: left"
            ),
            'port "arm" is not connected; name its topic in "topics": arm_left or arm_right',
        ),
    ],
)
def test_an_error_is_reported(tmp_path: Path, text: str, printed: str) -> None:
    assert printed in complaint(tmp_path, text)


def test_all_errors_are_reported_at_once(tmp_path: Path) -> None:
    text = GRAPH.replace("rate_hz", "rate") + "    host: left\nexternal_topics: [nothing]\n"
    with pytest.raises(BadInputError) as caught:
        load_graph(write(tmp_path, text))
    assert len(caught.value.problems) == 3


def test_a_wrong_key_in_a_scene_names_file_and_line(tmp_path: Path) -> None:
    scene = (ROOT / "launch/scenes/cylinder.yaml").read_text()
    line = next(i for i, text in enumerate(scene.splitlines(), 1) if "interocular_m" in text)
    (tmp_path / "scene.yaml").write_text(scene.replace("interocular_m", "interocular"))
    printed = complaint(tmp_path, GRAPH + "scene: scene.yaml\n")
    assert f'scene.yaml:{line}: eyes.interocular: unknown key "interocular"' in printed
    assert 'did you mean "interocular_m"?' in printed
    assert '"interocular_m" is missing' in printed


@pytest.mark.parametrize(
    ("setting", "printed"),
    [
        ("beacon", "write node.parameter=value"),
        ("console.page_port=8081", 'unknown node "console"; add --console'),
        ("beacn.rate_hz=3", 'unknown node "beacn"; did you mean "beacon"?'),
        ("beacon.rate=3", 'unknown key "rate"; did you mean "rate_hz"?'),
        ("beacon.rate=3", '--set beacon.rate=3: nodes.beacon.parameters.rate: unknown key "rate"'),
        ("beacon.rate_hz=slow", "--set beacon.rate_hz=slow: nodes.beacon.parameters.rate_hz"),
        ("beacon.rate_hz.deep=3", "is not a mapping"),
    ],
)
def test_wrong_settings_are_named(tmp_path: Path, setting: str, printed: str) -> None:
    assert printed in complaint(tmp_path, GRAPH, settings=[setting])


def test_settings_and_record_win_over_the_file(tmp_path: Path) -> None:
    plan = load_graph(
        write(tmp_path, GRAPH),
        settings=["beacon.rate_hz=7", "recorder.compress=false"],
        record=tmp_path / "a.mcap",
    )
    assert plan.nodes["beacon"].parameters["rate_hz"] == 7.0
    recorder = plan.nodes["recorder"]
    assert recorder.parameters["bag"] == str(tmp_path / "a.mcap")
    assert recorder.parameters["compress"] is False
    assert {port.topic for port in recorder.inputs} == {
        "twin/finger", "arming", "estop", "host", "status", "display", "twin/finger_path", "eye",
        "recording", "bookmark", "parameter", "force",
    }  # fmt: skip


def test_a_topic_from_tools_needs_no_node(tmp_path: Path) -> None:
    text = f"nodes: {{listener: {{type: '{LISTENER}'}}}}\nexternal_topics: [twin/finger]\n"
    plan = load_graph(write(tmp_path, text))
    assert plan.nodes["listener"].inputs[0].endpoints == ("ipc://@run/tools.twin.finger",)


def test_a_port_can_be_left_out(tmp_path: Path) -> None:
    text = f"nodes: {{listener: {{type: '{LISTENER}', topics: {{twin__finger: null}}}}}}\n"
    plan = load_graph(write(tmp_path, text))
    ports = {port.port: port.endpoints for port in plan.nodes["listener"].inputs}
    assert ports["twin__finger"] == ()


@pytest.mark.parametrize("name", ["demo", "lab", "replay"])
def test_the_launch_files_of_the_house_resolve(name: str) -> None:
    plan = load_graph(ROOT / "launch" / f"{name}.yaml")
    assert plan.scene_message() is not None
    for node in plan.nodes.values():
        for port in node.inputs:
            if not port.endpoints:
                continue
            local = [one for one in port.endpoints if one.startswith("ipc")]
            far = [one for one in port.endpoints if one.startswith("tcp")]
            hosts = {writer.host for writer in plan.writers.get(port.topic, ())}
            assert bool(local) == (node.host in hosts)
            assert bool(far) == bool(hosts - {node.host})


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("planner.sheet_calibration=absent.yaml", "absent.yaml: cannot be read"),
        ("planner.sheet_calibration=calibrations/twin-bumblebee.yaml", "sheet"),
        ("triangulator.calibration=absent.yaml", "absent.yaml"),
    ],
)
def test_a_calibration_that_is_none_is_rejected_before_the_start(setting: str, words: str) -> None:
    with pytest.raises(BadInputError, match=words) as caught:
        load_graph(ROOT / "launch" / "demo.yaml", settings=[setting])
    assert setting.split("=", maxsplit=1)[0].split(".")[1] in str(caught.value)


def test_values_are_read_as_yaml() -> None:
    assert parse_value("3") == 3
    assert parse_value("1.0e-3") == pytest.approx(1e-3)
    assert parse_value("[1, a]") == [1, "a"]
    assert parse_value("on_failure") == "on_failure"


def test_the_example_of_the_page_on_launch_files_resolves(tmp_path: Path) -> None:
    page = (ROOT / "docs/launch-files.md").read_text()
    example = page.split("```yaml\n")[1].split("```")[0]
    plan = load_graph(write(tmp_path, example.replace("scenes/", f"{ROOT}/launch/scenes/")))
    assert plan.nodes["watcher"].outputs[-1].endpoints == ()
    assert "in/stereo" in [port.port for port in plan.nodes["recorder"].inputs]


def test_an_optional_input_without_a_writer_is_not_connected(tmp_path: Path) -> None:
    """The planner reads the latency of arms where the graph has arms."""
    file = tmp_path / "graph.yaml"
    file.write_text(
        f"scene: {ROOT}/launch/scenes/cylinder.yaml\nexternal_topics: [fingertip, soft_body]\n"
        "nodes:\n  planner: {type: planner}\n"
    )
    ports = {port.port: port for port in load_graph(file).nodes["planner"].inputs}
    assert ports["fingertip"].endpoints
    assert not ports["arm_latency"].endpoints
    with_arms = load_graph(ROOT / "launch" / "demo.yaml").nodes["planner"]
    assert all(port.endpoints for port in with_arms.inputs)


def test_a_launch_file_extends_another_by_name(tmp_path: Path) -> None:
    text = """
extends: demo
scene: organ
nodes:
  twin_eye: null
  renderer:
    parameters: {rate_hz: 20}
  beacon: {type: "tests.launch_nodes:Beacon", topics: {twin__finger: null}}
"""
    plan, demo = load_graph(write(tmp_path, text)), load_graph(ROOT / "launch/demo.yaml")
    assert set(plan.nodes) == {*demo.nodes, "beacon"} - {"twin_eye"}
    assert plan.nodes["renderer"].parameters["rate_hz"] == 20.0
    assert plan.nodes["renderer"].nice == demo.nodes["renderer"].nice
    calibration = plan.nodes["triangulator"].parameters["calibration"]
    assert calibration == demo.nodes["triangulator"].parameters["calibration"]
    assert plan.scene_file == str(ROOT / "launch/scenes/organ.yaml")


def test_a_name_without_file_lists_the_shipped_files(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r'exist; did you mean "demo"\? Shipped launch files: '):
        load_graph(tmp_path / "demmo")
    with pytest.raises(BadInputError, match="check the path, or name a shipped scene: box, "):
        load_scene(tmp_path / "nothing")
    printed = complaint(tmp_path, "extends: demo\n", settings=["scene=sphare"])
    assert 'does not exist; did you mean "sphere"? Shipped scenes: box, ' in printed


def test_a_launch_file_given_as_a_scene_is_one_error() -> None:
    with pytest.raises(BadInputError) as caught:
        load_scene(ROOT / "launch" / "demo.yaml")
    text = str(caught.value)
    assert "is a launch file, not a scene" in text
    assert "scenes/cylinder.yaml" in text
    assert len(text.splitlines()) == 1


@pytest.mark.parametrize("option", ["scene=graph.yaml", "scene=own.yaml"])
def test_a_launch_file_given_as_the_scene_of_another_is_one_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("own.yaml").write_text("extends: demo\n")
    errors = complaint(tmp_path, "extends: demo\nnodes: {}\n", settings=[option])
    assert "is a launch file, not a scene; give " in errors
    assert len(errors.splitlines()) == 1


@pytest.mark.parametrize(
    ("text", "printed"),
    [
        ("extends: demmo\n", 'graph.yaml:1: extends: "demmo" does not exist; did you mean "demo"?'),
        ("extends: graph.yaml\n", "graph.yaml:1: extends: "),
        ("extends: demo\nscene: nowhere\n", 'graph.yaml:2: scene: "nowhere" does not exist'),
        ("extends: demo\nnodes: {planner: {nise: 1}}\n", "graph.yaml:2: nodes.planner.nise: unkno"),
        ((ROOT / "launch/scenes/plane.yaml").read_text(), "the file is a scene, not a launch file"),
    ],
)
def test_an_error_of_an_extension_is_one_line(tmp_path: Path, text: str, printed: str) -> None:
    errors = complaint(tmp_path, text)
    assert printed in errors
    assert len(errors.splitlines()) == 1


def test_an_error_in_an_extended_file_names_that_file(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(GRAPH.replace("rate_hz: 20", "rate_hz: fast"))
    assert "base.yaml:6: nodes.beacon.parameters.rate_hz" in complaint(
        tmp_path, "extends: base.yaml\n"
    )


def test_a_handler_without_an_input_is_an_error_with_the_similar_name(tmp_path: Path) -> None:
    text = GRAPH.replace(f"type: {BEACON}", "type: tests.launch_nodes:MisspelledHandler")
    assert 'the method on_scen of "tests.launch_nodes:MisspelledHandler" handles no input; ' in (
        found := complaint(tmp_path, text)
    )
    assert 'did you mean "on_scene"' in found


def test_a_periodic_method_needs_a_parameter_with_its_rate(tmp_path: Path) -> None:
    text = GRAPH.replace(f"type: {BEACON}", "type: tests.launch_nodes:MisspelledRate")
    found = complaint(tmp_path, text)
    assert 'periodic with the rate "rate_hs", which is not a parameter of the node; ' in found
    assert 'did you mean "rate_hz"' in found


def test_live_parameters_need_an_input_for_their_changes(tmp_path: Path) -> None:
    text = GRAPH.replace(f"type: {BEACON}", "type: tests.launch_nodes:UnreachableParameter")
    assert "declare parameter: Input[ParameterChange] in the class" in complaint(tmp_path, text)


def test_only_scenes_are_scene_files(tmp_path: Path) -> None:
    assert is_scene_file(ROOT / "launch" / "scenes" / "sphere.yaml")
    assert not is_scene_file(ROOT / "launch" / "demo.yaml")
    assert not is_scene_file(ROOT / "launch" / "calibrations" / "twin-bumblebee.yaml")
    assert not is_scene_file(write(tmp_path, "camera: {}\narms: {}\nsheet: {}\n"))


@pytest.mark.parametrize(
    ("type_name", "remedy"),
    [
        ("no.such:Thing", "PYTHONPATH=FOLDER before the command, where FOLDER contains the module"),
        ("tests.launch_nodes:Thing", "define the class Thing in tests.launch_nodes"),
    ],
)
def test_a_node_that_cannot_be_imported_names_one_remedy(
    tmp_path: Path, type_name: str, remedy: str
) -> None:
    errors = complaint(tmp_path, GRAPH.replace(f"type: {BEACON}", f"type: {type_name}"))
    assert remedy in errors
    assert len(errors.splitlines()) == 1, "the listener's topic without a writer follows from it"


def test_another_scene_is_a_setting(tmp_path: Path) -> None:
    plan = load_graph(ROOT / "launch/demo.yaml", settings=["scene=launch/scenes/plane.yaml"])
    assert plan.scene is not None
    assert plan.scene["object"]["geometry"]["shape"] == "plane"
    wrong = complaint(tmp_path, "extends: demo\n", settings=["scene=none.yaml"])
    assert wrong.splitlines()[0].startswith("--scene none.yaml: scene: ")


BRIDGE = "type: arm_bridge, topics: {arm: arm_left, other_arm: null}"
IN_ONE_PROCESS = f"""
scene: {ROOT / "launch" / "scenes" / "cylinder.yaml"}
hosts:
  main: {{address: 127.0.0.1}}
  left: {{address: 127.0.0.2}}
external_topics: [sheet_target]
nodes:
  twin_arms: {{type: twin_arms, process: arm}}
  bridge:
    {{{BRIDGE}, process: arm, parameters: {{side: left, host: 127.0.0.1, port: 5020}}}}
  beacon: {{type: "{BEACON}"}}
  listener: {{type: "{LISTENER}"}}
"""


def test_a_bridge_shares_its_process_with_its_own_simulator(tmp_path: Path) -> None:
    plan = load_graph(write(tmp_path, IN_ONE_PROCESS))
    names = [[node.name for node in one.nodes] for one in plan.processes_on("main")]
    assert ["twin_arms", "bridge"] in names
    assert ["beacon"] in names


@pytest.mark.parametrize(
    ("old", "new", "printed"),
    [
        (f'"{BEACON}"}}', f'"{BEACON}", process: arm}}', 'fault of "beacon" would stop the arm'),
        ("port: 5020", "port: 5022", 'fault of "twin_arms" would stop the arm of "bridge"'),
        ("process: arm}", "process: arm, nice: 3}", "set the same nice for both nodes"),
        ("process: arm}", "process: arm, realtime_priority: 9}", "set the same realtime_priority"),
        ("process: arm}", "process: arm, host: left}", "set the same host for both nodes"),
        ("process: arm", "process: beacon", "is the name of another node"),
        ("process: arm", "process: plan", "or is reserved"),
        ("process: arm", "process: 3", "process"),
    ],
)
def test_a_process_that_cannot_be_shared_is_rejected(
    tmp_path: Path, old: str, new: str, printed: str
) -> None:
    assert printed in complaint(tmp_path, IN_ONE_PROCESS.replace(old, new))


def test_the_launch_file_can_let_others_into_the_process_of_a_bridge(tmp_path: Path) -> None:
    text = IN_ONE_PROCESS.replace(f'"{BEACON}"}}', f'"{BEACON}", process: arm}}')
    plan = load_graph(write(tmp_path, text.replace(BRIDGE, f"{BRIDGE}, shares_arm_process: true")))
    [shared] = [one for one in plan.processes_on("main") if one.name == "arm"]
    assert [node.name for node in shared.nodes] == ["twin_arms", "bridge", "beacon"]


def test_a_name_without_unit_is_completed() -> None:
    known = ["speed_m_per_s", "spin", "turn_rad_per_s", "turn_jerk_rad_per_s3"]
    assert did_you_mean("speed", known) == 'did you mean "speed_m_per_s"?'
    assert did_you_mean("turn", known).startswith("choose one of: ")
    assert did_you_mean("spine", known) == 'did you mean "spin"?'
