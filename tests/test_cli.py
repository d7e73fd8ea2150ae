"""Test the `flexsheet` command: data on stdout, messages on stderr, exit codes."""

from __future__ import annotations

import importlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from flexsheet import read_topic, running_graph
from flexsheet.launch.commands import launching
from flexsheet.launch.commands.session import describe_node, describe_output, explain_counts
from flexsheet.launch.experiments.run import DEMO_FILE
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.running import runs
from flexsheet.messages.bag import BagReader, BagWriter
from flexsheet.messages.base import Header
from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import Display, EStop, PortStatus, Status
from flexsheet.nodes import NODES, NodeImportError
from tests.commands import Command
from tests.example_bag import write_example
from tests.test_doctor_hosts import make_status
from tests.test_experiments import make_family
from tests.waiting import DEADLINE_S, wait_until

ROOT = Path(__file__).resolve().parent.parent
GRAPH: dict[str, Any] = {
    "nodes": {
        "beacon": {"type": "tests.launch_nodes:Beacon"},
        "listener": {"type": "tests.launch_nodes:Listener"},
    }
}
LISTENING: dict[str, Any] = {
    "nodes": {"listener": {"type": "tests.launch_nodes:Listener"}},
    "external_topics": ["twin/finger"],
}


@pytest.fixture(scope="module")
def runs_root() -> Iterator[Path]:
    """Create a directory of runs for this file's tests."""
    folder = Path(tempfile.mkdtemp(prefix="fs-", dir="/tmp"))
    before = os.environ.get(runs.ROOT_VARIABLE)
    os.environ[runs.ROOT_VARIABLE] = str(folder)
    yield folder
    if before is None:
        del os.environ[runs.ROOT_VARIABLE]
    else:
        os.environ[runs.ROOT_VARIABLE] = before
    shutil.rmtree(folder)


class Launched:
    """Process of `flexsheet launch`, from ready to stop."""

    def __init__(self, path: Path, *options: object) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "flexsheet", "launch", str(path), *map(str, options)],
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self.process.stderr is not None
        printed = ""
        for line in self.process.stderr:
            printed += line
            if "are ready" in line:
                break
        else:
            pytest.fail(f"the graph did not come up: {printed}")
        # Nobody reads on: the pipe must not fill.
        self._drain = threading.Thread(target=self.process.stderr.read)
        self._drain.start()

    def stop(self) -> int:
        self.process.send_signal(signal.SIGINT)
        self._drain.join()
        code = self.process.wait()
        assert self.process.stderr is not None
        self.process.stderr.close()
        return code


def write(folder: Path, graph: dict[str, Any]) -> Path:
    path = folder / "graph.yaml"
    path.write_text(json.dumps(graph))
    return path


@pytest.fixture(scope="module")
def running(runs_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Run and record a small graph; yield its bag, which is complete after the tests."""
    folder = tmp_path_factory.mktemp("graph")
    launched = Launched(write(folder, GRAPH), "--record", folder / "run.mcap")
    yield folder / "run.mcap"
    assert launched.stop() == 0


def contains_stop(bag: Path) -> bool:
    """Return whether the bag contains the listener's stop and its report."""
    stopped = False
    for topic, message, header, _ in BagReader(
        bag, {"estop", "status"} & set(BagReader(bag).topics)
    ):
        stopped |= topic == "estop"
        if stopped and isinstance(message, Status) and header.writer == "listener":
            return True
    return False


@pytest.fixture(scope="module")
def recorded(running: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record a complete bag of the small graph."""
    folder = tmp_path_factory.mktemp("recorded")
    launched = Launched(write(folder, GRAPH), "--record", folder / "a.mcap")
    # The listener hears the tenth beat a fifth of a second after the start, and says so by and by.
    wait_until(lambda: contains_stop(folder / "a.mcap"), "the listener's stop in the bag")
    assert launched.stop() == 0
    return folder / "a.mcap"


def test_help_names_every_command(flexsheet: Command) -> None:
    printed = flexsheet("--help")
    assert printed.code == 0
    for name in ("launch", "node", "topic", "bag", "calibrate", "doctor"):
        assert name in printed.out


def test_help_and_the_table_of_topics_load_no_heavy_library() -> None:
    code = (
        "import sys; sys.argv = ['flexsheet', 'topic', 'list', '--all', '--json']\n"
        "from flexsheet.__main__ import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "print([name for name in ('cv2', 'scipy', 'matplotlib', 'mcap', 'moderngl') "
        "if name in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert done.stderr.strip() == "[]"
    assert len(json.loads(done.stdout)) == len(TOPICS)


def test_topic_list_is_the_table(flexsheet: Command) -> None:
    rows = flexsheet("topic", "list", "--all", "--json").json()
    assert [row["topic"] for row in rows] == list(TOPICS)
    assert {row["topic"]: row["expected_rate_hz"] for row in rows}["stereo"] == [30, 130]
    heading, *lines = flexsheet("topic", "list", "--all").out.splitlines()
    assert heading.split()[:4] == ["topic", "message", "delivery", "expected_rate_hz"]
    shown = {line.split()[0]: line.split()[3:5] for line in lines}
    assert shown["stereo"][0] == "30-130"
    assert shown["twin/finger_path"] == ["on", "change"]


def test_topic_list_contains_the_topics_of_the_running_graph(
    flexsheet: Command, running: Path
) -> None:
    listed = [row["topic"] for row in flexsheet("topic", "list", "--json").json()]
    assert {"twin/finger", "estop", "status"} <= set(listed)
    assert not {"stereo", "twin/eye", "clocks"} & set(listed)
    assert listed == [topic for topic in TOPICS if topic in listed]


def test_topic_list_without_a_graph_contains_all_topics(
    flexsheet: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(runs.ROOT_VARIABLE, str(tmp_path))
    printed = flexsheet("topic", "list", "--json")
    assert [row["topic"] for row in printed.json()] == list(TOPICS)
    assert "all defined topics follow" in printed.err


def test_node_types_and_info(flexsheet: Command) -> None:
    assert [row["type"] for row in flexsheet("node", "list", "--all", "--json").json()] == list(
        NODES
    )
    described = flexsheet("node", "info", "planner", "--json").json()
    assert {"port": "sheet_target", "direction": "output", "message": "SheetTarget"} in described[
        "ports"
    ]
    assert "prediction_horizon_s" in [row["parameter"] for row in described["parameters"]]
    printed = flexsheet("node", "info", "tests.launch_nodes:Beacon")
    assert "twin__finger" in printed.out
    assert "rate_hz" in printed.out
    printed = flexsheet("node", "info", "planer")
    assert (printed.code, printed.out) == (2, "")
    assert 'did you mean "planner"?' in printed.err


@pytest.mark.parametrize(
    ("text", "printed"),
    [
        ("x = undefined\n", "NameError: name 'undefined' is not defined"),
        ("import no_such\n", "ModuleNotFoundError: No module named 'no_such'"),
        ("import sys\nsys.exit(3)\n", "SystemExit: 3"),
    ],
    ids=("name", "missing", "exit"),
)
def test_an_error_in_the_module_of_a_node_is_reported(
    *,
    flexsheet: Command,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    text: str,
    printed: str,
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv(runs.ROOT_VARIABLE, str(tmp_path / "runs"))
    module = tmp_path / "node_with_error.py"
    module.write_text(text)
    monkeypatch.delitem(sys.modules, module.stem, raising=False)
    importlib.invalidate_caches()
    expected = f'"{module.stem}:Mine" cannot be imported: {printed}'
    graph = write(tmp_path, {"nodes": {"mine": {"type": f"{module.stem}:Mine"}}})
    for arguments in (("node", "info", f"{module.stem}:Mine"), ("launch", graph, "--dry-run")):
        result = flexsheet(*arguments)
        assert result.code == 2
        assert expected in result.err
        assert "Traceback" not in result.err


def test_dry_run_prints_the_plan_and_starts_nothing(
    flexsheet: Command, tmp_path: Path, runs_root: Path
) -> None:
    before = list(runs_root.iterdir())
    path = write(tmp_path, GRAPH)
    plan = flexsheet("launch", path, "--dry-run", "--json").json()
    assert plan["nodes"]["listener"]["inputs"][0]["topic"] == "twin/finger"
    printed = flexsheet("launch", path, "--dry-run", "--set", "beacon.rate_hz=12")
    assert '  beacon -->|"twin/finger"| listener' in printed.out.splitlines()
    assert printed.code == 0
    assert "rate_hz=12.0" in printed.out
    assert "ipc://@run/beacon.twin.finger" in printed.out
    assert list(runs_root.iterdir()) == before


def test_a_bad_launch_file_is_exit_code_two(flexsheet: Command, tmp_path: Path) -> None:
    (tmp_path / "graph.yaml").write_text("nodes:\n  a:\n    typ: camera\n")
    printed = flexsheet("launch", tmp_path / "graph.yaml")
    assert (printed.code, printed.out) == (2, "")
    assert 'graph.yaml:3: nodes.a.typ: unknown key "typ"; did you mean "type"?' in printed.err
    assert "Traceback" not in printed.err


def test_a_node_that_fails_for_good_is_exit_code_one(tmp_path: Path, runs_root: Path) -> None:
    beacon = {"type": "tests.launch_nodes:Beacon", "parameters": {"exit_code": 3}}
    path = write(tmp_path, {"nodes": {"beacon": {**beacon, "restart": {"policy": "never"}}}})
    done = subprocess.run(
        [sys.executable, "-m", "flexsheet", "launch", str(path)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert "beacon ended with exit code 3" in done.stderr


def test_echo_prints_messages_and_stops(flexsheet: Command, running: Path) -> None:
    printed = flexsheet("topic", "echo", "twin/finger", "--once", "--timeout", DEADLINE_S)
    assert printed.code == 0
    assert printed.out.startswith("--- beacon #")
    assert "path_label: count" in printed.out
    printed = flexsheet(
        "topic", "echo", "twin/finger", "--count", "2", "--field", "path_time_s", "--json"
    )
    one, two = (json.loads(line) for line in printed.out.splitlines())
    assert two["message"] > one["message"] > 0
    assert one["header"]["writer"] == "beacon"


def path_text(times_s: list[float]) -> str:
    """Return the text of a finger path with two points and the given times."""
    return json.dumps(
        {
            "label": "there",
            "times_s": times_s,
            "positions_world_m": [[0.0, 0.0, 0.0], [0.01, 0.0, 0.0]],
            "wander_m": 0.0,
            "tremor_m": 0.0,
        }
    )


@pytest.mark.parametrize(
    ("arguments", "code", "word"),
    [
        (("echo", "twin/fingr"), 2, 'did you mean "twin/finger"?'),
        (("echo", "twin/finger", "--field", "path_tim_s"), 2, 'did you mean "path_time_s"?'),
        (("echo", "fingertip"), 1, '"fingertip" has no writer'),
        (("echo", "display", "--once", "--timeout", "0.2"), 1, 'no message on "display"'),
        (("hz", "display", "--duration", "0.2"), 1, 'no message on "display"'),
        (("pub", "estop", "{engaged: maybe}"), 2, "MESSAGE (EStop): engaged"),
        (("pub", "estop", "{engaged: ["), 2, "not valid YAML or JSON"),
        (("pub", "twin/finger_path", path_text([0, 0])), 2, "does not come after times_s[0] = 0"),
        (("pub", "twin/finger_path", path_text([0])), 2, "1 times for 2 points"),
        (("pub", "estop", "@nowhere.yaml"), 2, "cannot be read"),
        (("echo", "estop", "--run", "/nowhere"), 2, "does not contain plan.json"),
    ],
)
def test_wrong_arguments_of_topic_commands(
    flexsheet: Command, running: Path, arguments: tuple[str, ...], code: int, word: str
) -> None:
    printed = flexsheet("topic", *arguments)
    assert printed.code == code
    assert word in printed.err


def test_a_message_of_any_size_is_taken_as_json(
    flexsheet: Command, running: Path, tmp_path: Path
) -> None:
    skin = {
        "mesh_id": "m",
        "vertices_world_m": [[0.0, 0.001 * i, 0.0] for i in range(4000)],
        "triangles": [[0, i, i + 1] for i in range(8000)],
    }
    file = tmp_path / "skin.json"
    file.write_text(json.dumps(skin))
    printed = flexsheet("topic", "pub", "skin", f"@{file}")
    assert 'topic "skin" is not part of the graph' in printed.err, "it was read, and whole"
    for text, word in (
        ('{"engaged": true, "engaged": false, "reason": ""}', "duplicate key"),
        ('{"engaged": NaN, "reason": ""}', "MESSAGE (EStop): engaged"),
        ("[" * 100_000, "lists or mappings are nested"),
    ):
        printed = flexsheet("topic", "pub", "estop", text)
        assert printed.code == 2
        assert word in printed.err


def test_a_tool_cannot_publish_for_a_node(flexsheet: Command, running: Path) -> None:
    finger = (
        "{path_label: '', path_done: true, path_time_s: 0, position_world_m: [0, 0, 0], "
        "velocity_world_m_per_s: [0, 0, 0]}"
    )
    printed = flexsheet("topic", "pub", "twin/finger", finger)
    assert printed.code == 2
    assert "is written by beacon" in printed.err


def test_rate_bandwidth_and_age_are_measured_per_writer(flexsheet: Command, running: Path) -> None:
    (row,) = flexsheet("topic", "hz", "twin/finger", "--duration", "1", "--json").json()
    assert row["writer"] == "beacon"
    assert row["lost"] == 0
    assert 5 < row["rate_hz"] < 60
    assert 0 < row["mean_bytes"] < 5000
    assert row["bytes_per_s"] > 0
    assert 0 < row["age_ms"]["p50"] <= row["age_ms"]["max"]
    assert "beacon" in flexsheet("topic", "hz", "status", "--duration", "2.5").out


def test_info_shows_the_graph(flexsheet: Command, running: Path) -> None:
    described = flexsheet("topic", "info", "twin/finger", "--json").json()
    assert described["writers"] == ["beacon"]
    assert described["readers"] == ["listener", "recorder"]
    assert described["fields"]["path_time_s"]["type"].startswith("float")


def test_info_gives_type_default_and_description(flexsheet: Command) -> None:
    fields = flexsheet("topic", "info", "sheet_target", "--json").json()["fields"]
    assert fields["push_depth_m"] == {
        "type": "float",
        "default": "required",
        "description": "depth of the fingertip below the surface of the undeformed object",
    }
    assert fields["trajectory"]["type"] == "SheetTrajectory or none"
    assert (fields["trajectory"]["default"], fields["normal_offset_m"]["default"]) == (
        "None",
        "0.0",
    )


def test_nodes_of_the_running_graph_are_listed(flexsheet: Command, running: Path) -> None:
    rows = {row["node"]: row for row in flexsheet("node", "list", "--json").json()}
    assert rows["beacon"]["type"] == "tests.launch_nodes:Beacon"
    described = flexsheet("node", "info", "beacon", "--json").json()
    assert {"port": "twin__finger", "direction": "output", "message": "TwinFinger",
            "topic": "twin/finger"} in described["ports"]  # fmt: skip
    assert "value" in described["parameters"][0]


def test_status_shows_rates_of_all_nodes(flexsheet: Command, running: Path) -> None:
    def topics_of_beacon() -> set[str]:
        rows = flexsheet("status", "--json").json()["nodes"]
        (beacon,) = (row for row in rows if row["node"] == "beacon")
        return {port["topic"] for port in beacon["outputs"]}

    # The first status is sent before it is counted.
    wait_until(lambda: topics_of_beacon() >= {"twin/finger", "status"}, "a counted status")
    printed = flexsheet("status", "--json")
    assert printed.code == 0, printed.out
    assert {row["node"] for row in printed.json()["nodes"]} >= {"beacon", "listener", "recorder"}
    assert printed.json()["self_checks"] == []
    shown = " ".join(flexsheet("status").out.split())
    assert re.search(r"twin/finger \d+ Hz", shown)
    assert "status " not in shown


def test_status_states_which_of_several_graphs_it_shows(flexsheet: Command, running: Path) -> None:
    shown = runs.list_live_runs()[0]
    other = runs.create_run()
    try:
        printed = flexsheet("status")
        as_json = flexsheet("status", "--json").json()
    finally:
        shutil.rmtree(other.directory)
    assert printed.err.startswith("2 graphs are running; this is ")
    assert f"graph.yaml, run {shown.directory}" in printed.err.splitlines()[0]
    assert f"to show starting: flexsheet status --run {other.directory}" in printed.err
    assert set(as_json["running"]) == {str(shown.directory), str(other.directory)}


@pytest.mark.parametrize(
    "arguments",
    [
        ("stop",),
        ("param", "set", "planner.max_age_s", "0.1"),
        ("topic", "pub", "display", "{correction: none, stereo: mono}"),
        ("arms", "enable"),
        ("arms", "disable"),
        ("arms", "reset"),
    ],
    ids=" ".join,
)
def test_a_command_does_not_choose_which_of_several_graphs_it_changes(
    flexsheet: Command,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: tuple[str, ...],
) -> None:
    monkeypatch.setenv(runs.ROOT_VARIABLE, str(tmp_path))
    monkeypatch.setattr(os, "kill", lambda *_: pytest.fail("a graph was stopped"))
    made = [runs.create_run() for _ in range(2)]
    made[0].plan_file.write_text(json.dumps({"launch_file": "own.yaml"}))
    printed = flexsheet(*arguments)
    assert printed.code == 2
    assert "2 graphs are running, so --run is required; choose one:" in printed.err
    assert f"--run {made[0].directory} (own.yaml)" in printed.err
    assert f"--run {made[1].directory} (starting)" in printed.err


def test_status_distinguishes_skipped_from_lost_messages() -> None:
    port = PortStatus(
        topic="frame", rate_hz=25.0, age_s=None, messages=9, dropped=4, gaps=2, rejected=1
    )
    node = load_graph(DEMO_FILE).nodes["renderer"]
    row = describe_node(node, make_status("renderer", inputs=(port,)))
    assert (row["skipped"], row["lost"]) == (4, 3)
    skipped, lost = explain_counts([row])
    assert skipped.startswith("skipped: renderer 4 of frame. ")
    assert "This is normal" in skipped
    assert lost.startswith("lost: renderer 3 of frame. ")
    assert "`flexsheet logs renderer`" in lost
    assert explain_counts([{**row, "lost": 0}]) == [skipped]
    assert explain_counts([{**row, "skipped": 0, "lost": 0}, {**row, "lost": None}]) == [skipped]


def test_status_reports_the_overflow_of_a_queue_as_a_problem() -> None:
    port = PortStatus(
        topic="arm_latency", rate_hz=1.0, age_s=None, messages=9, dropped=2, gaps=0, rejected=0
    )
    node = load_graph(DEMO_FILE).nodes["renderer"]
    (text,) = explain_counts([describe_node(node, make_status("renderer", inputs=(port,)))])
    assert text.startswith("skipped: renderer 2 of arm_latency. The node needed these messages")


def test_status_shows_no_rate_that_has_no_meaning() -> None:
    port = {"topic": "frame", "rate_hz": 0.0, "messages": 1}
    assert describe_output(port) == "frame"
    assert describe_output({**port, "messages": 2}) == "frame 0 Hz"
    assert describe_output({**port, "topic": "scene", "messages": 9}) == "scene"


def test_launch_prints_the_address_of_the_console_once(
    flexsheet: Command, runs_root: Path, tmp_path: Path
) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    values = {"scene": str(Path("launch/scenes/rigid-plane.yaml").resolve()), **GRAPH}
    printed = flexsheet(
        "launch", write(tmp_path, values), "--console",
        "--set", f"console.page_port={port}", "--duration", "0.1",
    )  # fmt: skip
    assert printed.code == 0, printed.err
    assert printed.err.count(f"console: http://127.0.0.1:{port}/") == 1


def test_launch_prints_why_a_node_is_not_started(
    flexsheet: Command, runs_root: Path, tmp_path: Path
) -> None:
    values = {
        "scene": str(Path("launch/scenes/rigid-plane.yaml").resolve()),
        "nodes": {**GRAPH["nodes"], "fem_solver": {"type": "fem_solver"}},
    }
    printed = flexsheet("launch", write(tmp_path, values), "--duration", "0.1")
    assert printed.code == 0, printed.err
    assert "fem_solver is not started: the scene's object is rigid: it has no mat" in printed.err


def test_logs_print_the_log_of_a_node(flexsheet: Command, running: Path) -> None:
    lines = flexsheet("logs", "recorder", "--json").out.splitlines()
    assert any(json.loads(line)["event"] == "recording" for line in lines)
    assert len(flexsheet("logs", "recorder", "-n", "1").out.splitlines()) == 1
    (line,) = flexsheet("logs", "recorder", "-n", "1", "--json").out.splitlines()
    written = datetime.fromisoformat(json.loads(line)["timestamp"]).astimezone()
    (shown,) = flexsheet("logs", "recorder", "-n", "1").out.splitlines()
    assert f"{written:%H:%M:%S}." in shown.partition(json.loads(line)["event"])[0]
    printed = flexsheet("logs", "recorder", "-n", "0")
    assert (printed.code, printed.out, printed.err) == (0, "", "")
    run = runs.list_live_runs()[0]
    (run.logs / "silent.log").touch()
    printed = flexsheet("logs", "silent")
    assert (printed.code, printed.out) == (0, "")
    assert printed.err == "the log of silent has no entries\n"
    listed = flexsheet("logs", "--json").json()
    assert {"node": "recorder"} in listed
    assert {"node": "beacon"} in listed
    printed = flexsheet("logs", "recordr")
    assert (printed.code, 'did you mean "recorder"?' in printed.err) == (2, True)


def test_a_parameter_is_read_and_changed_in_the_running_graph(
    flexsheet: Command, running: Path
) -> None:
    rows = {row["parameter"]: row for row in flexsheet("param", "get", "--json").json()}
    assert rows["listener.patience_s"]["live"]
    assert not rows["beacon.rate_hz"]["live"]
    assert flexsheet("param", "set", "listener.patience_s", "2.5", "--json").json()["value"] == 2.5
    assert flexsheet("param", "get", "listener.patience_s").out == "2.5\n"
    (row,) = flexsheet("param", "get", "listener.patience_s", "--json").json()
    assert (row["value"], row["live"]) == (2.5, True)
    assert "beacon" not in flexsheet("param", "get", "listener").out
    lines = flexsheet("param", "get").out.splitlines()
    assert lines[0].split() == ["parameter", "value", "live"]
    recorded = next(line for line in lines if line.startswith("recorder.topics "))
    assert "null" in recorded or "[" in recorded


def test_parameters_of_a_node_that_cannot_be_imported_here_are_listed(
    flexsheet: Command, running: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(name: str) -> None:
        raise NodeImportError("no module; write PYTHONPATH=FOLDER before the command")

    monkeypatch.setattr("flexsheet.nodes.node_class", refuse)
    rows = {row["parameter"]: row for row in flexsheet("param", "get", "--json").json()}
    assert rows["beacon.rate_hz"]["live"] is None
    assert flexsheet("param", "get", "beacon.rate_hz").code == 0
    printed = flexsheet("param", "set", "beacon.rate_hz", "3")
    assert printed.code == 1
    assert "PYTHONPATH=FOLDER" in printed.err


@pytest.mark.parametrize(
    ("arguments", "code", "printed"),
    [
        (("set", "beacon.rate_hz", "9"), 2, "start the graph again with --set beacon.rate_hz=9"),
        (
            ("set", "listener.patience_s", "soon"),
            2,
            "listener.patience_s: 'soon' is invalid; write a number in s, without the unit",
        ),
        (("set", "listener.patience", "1"), 2, 'did you mean "patience_s"?'),
        (("get", "listner.patience_s"), 2, 'did you mean "listener"?'),
    ],
)
def test_a_parameter_that_cannot_be_changed_is_explained(
    flexsheet: Command, running: Path, arguments: tuple[str, ...], code: int, printed: str
) -> None:
    result = flexsheet("param", *arguments)
    assert (result.code, printed in result.err) == (code, True), result.err


@pytest.mark.usefixtures("running")
async def test_a_program_reads_a_graph_of_another_process() -> None:
    graph = running_graph()
    read = [header.writer async for _, header in read_topic(graph, "twin/finger", count=2)]
    assert read == ["beacon", "beacon"]


def test_a_node_that_is_omitted_must_exist(
    flexsheet: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    tables: dict[tuple[str, ...], list[tuple[Any, ...]]] = {}
    monkeypatch.setattr(launching, "print_table", tables.__setitem__)
    printed = flexsheet("launch", "demo", "--without", "planer", "--dry-run")
    assert (printed.code, 'did you mean "planner"?' in printed.err) == (2, True)
    printed = flexsheet("launch", "demo", "--without", "planner", "--dry-run")
    assert printed.code == 0
    (nodes,) = (rows for columns, rows in tables.items() if columns[0] == "node")
    names = {row[0] for row in nodes}
    assert names == load_graph(DEMO_FILE).nodes.keys() - {"planner"}


def test_a_graph_is_stopped(tmp_path: Path, runs_root: Path) -> None:
    command = [sys.executable, "-m", "flexsheet"]
    graph = subprocess.Popen(
        [*command, "launch", str(write(tmp_path, GRAPH)), "--json"],
        cwd=ROOT, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert graph.stdout is not None
        run = json.loads(graph.stdout.readline())["run"]
        subprocess.run([*command, "stop", "--run", run], cwd=ROOT, check=True, timeout=DEADLINE_S)
        assert graph.wait(DEADLINE_S) == 0
    finally:
        if graph.poll() is None:
            graph.kill()
        if graph.stdout is not None:
            graph.stdout.close()


def test_pub_reaches_the_graph(flexsheet: Command, running: Path) -> None:
    printed = flexsheet(
        "topic", "pub", "display", "{correction: none, stereo: mono}", "--count", "2"
    )
    assert printed.code == 0
    assert 'sent 2 on "display"' in printed.err
    assert "if a node refuses the message, `flexsheet status` shows why" in printed.err
    live = flexsheet("bag", "info", running, "--json")
    assert live.code == 0


def test_a_running_graph_can_be_recorded(flexsheet: Command, running: Path, tmp_path: Path) -> None:
    bag = tmp_path / "b.mcap"
    printed = flexsheet("bag", "record", bag, "--topic", "twin/finger", "--duration", "0.5")
    assert printed.code == 0
    info = flexsheet("bag", "info", bag, "--json").json()
    assert info["complete"]
    assert [topic["name"] for topic in info["topics"]] == ["twin/finger"]
    printed = flexsheet("bag", "record", bag)
    assert (printed.code, "the file exists" in printed.err) == (2, True)
    printed = flexsheet("bag", "record", tmp_path / "c.mcap", "--topic", "stereo")
    assert (printed.code, "has no writer" in printed.err) == (2, True)


def test_verify_steps_a_node_and_compares(
    flexsheet: Command, recorded: Path, tmp_path: Path
) -> None:
    result = flexsheet("bag", "verify", recorded, "listener", "--json").json()
    assert result["ok"], str(result)
    assert result["same_bytes"]
    assert result["topics"]["estop"] == {
        "recorded": 1, "replayed": 1, "compared": 1, "beyond_tolerance": 0, "worst": {},
    }  # fmt: skip
    assert flexsheet("bag", "verify", recorded, "listener").code == 0


def test_verify_sees_another_output(flexsheet: Command, recorded: Path, tmp_path: Path) -> None:
    forged = tmp_path / "forged.mcap"
    reader = BagReader(recorded)
    with BagWriter(forged, reader.metadata) as writer:
        writer.add_attachment("plan.json", reader.attachment("plan.json"), "application/json")
        for topic, message, header, log_ns in reader:
            other = EStop(engaged=True, reason="eleven") if topic == "estop" else message
            writer.write(TOPICS[topic], other, header, log_ns)
    printed = flexsheet("bag", "verify", forged, "listener", "--json")
    assert printed.code == 3
    assert printed.json()["topics"]["estop"]["worst"] == {"reason": 1.0}


def test_a_node_that_fails_for_good_ends_an_experiment_in_a_sentence(
    flexsheet: Command, tmp_path: Path
) -> None:
    launch_file = tmp_path / "broken.yaml"
    scene = Path(__file__).parent.parent / "launch" / "scenes" / "cylinder.yaml"
    launch_file.write_text(
        f"scene: {scene}\n"
        "nodes:\n"
        "  broken: {type: 'launch_nodes:Beacon', parameters: {exit_code: 3},\n"
        "           restart: {policy: never}}\n"
    )
    printed = flexsheet("experiment", "stroke", "--launch", launch_file, "--output", tmp_path / "o")
    assert printed.code == 1
    assert "broken ended with exit code" in printed.err
    assert "Traceback" not in printed.err


def test_a_setting_that_is_no_yaml_is_named(flexsheet: Command) -> None:
    setting = "planner.prediction_horizon_s=[1,"
    printed = flexsheet("launch", "launch/demo.yaml", "--dry-run", "--set", setting)
    assert printed.code == 2
    assert setting in printed.err
    assert "Traceback" not in printed.err


def test_verify_reports_missing_inputs(flexsheet: Command, recorded: Path, tmp_path: Path) -> None:
    printed = flexsheet("bag", "verify", recorded, "listner")
    assert (printed.code, 'did you mean "listener"?' in printed.err) == (2, True)
    printed = flexsheet("bag", "verify", recorded, "recorder")
    assert (printed.code, "it recorded this bag" in printed.err) == (1, True)
    bare = tmp_path / "bare.mcap"
    with BagWriter(bare):
        pass
    assert (
        'does not contain the attachment "plan.json"'
        in flexsheet("bag", "verify", bare, "listener").err
    )
    assert flexsheet("bag", "info", tmp_path / "no.mcap").code == 2


def test_a_bag_plays_into_a_graph(
    flexsheet: Command, recorded: Path, runs_root: Path, tmp_path: Path
) -> None:
    launched = Launched(write(tmp_path, LISTENING), "--record", tmp_path / "b.mcap")
    into = ("--run", runs.list_live_runs()[0].directory)
    printed = flexsheet("bag", "play", recorded, "--rate", "4", "--topic", "twin/finger", *into)
    refused = flexsheet("bag", "play", recorded, "--topic", "stereo", *into)
    assert launched.stop() == 0
    assert printed.code == 0, printed.err
    assert (refused.code, "not in the bag" in refused.err) == (1, True)
    sent = list(BagReader(recorded, ["twin/finger"]))
    got = list(BagReader(tmp_path / "b.mcap", ["twin/finger"]))
    assert [message.path_time_s for _, message, _, _ in got] == [  # type: ignore[attr-defined]  # one type on the topic
        message.path_time_s
        for _, message, _, _ in sent  # type: ignore[attr-defined]
    ]
    # As old as when they were recorded, four times as close together, however late each was sent.
    shifts_ns = [
        played.source_ns - (original.source_ns - log_ns + log_ns // 4)
        for (_, _, played, _), (_, _, original, log_ns) in zip(got, sent, strict=True)
    ]
    assert max(shifts_ns) - min(shifts_ns) < 1000
    # The launcher keeps what the listener has said.
    stops = list(BagReader(tmp_path / "b.mcap", ["estop"]))
    assert {header.writer for _, _, header, _ in stops} == {"listener", "launch"}


def test_a_bag_is_not_played_beside_the_nodes_that_write_its_topics(
    flexsheet: Command, recorded: Path, running: Path
) -> None:
    printed = flexsheet("bag", "play", recorded)
    assert printed.code == 1
    assert "not played: twin/finger: beacon writes it" in printed.err
    assert f"flexsheet bag play {recorded} --launch replay" in printed.err


def test_play_can_bring_its_graph_and_restores_latched_topics_first(
    flexsheet: Command, runs_root: Path, tmp_path: Path
) -> None:
    bag = tmp_path / "made.mcap"
    with BagWriter(bag) as writer:
        for i in range(5):
            header = Header(i + 1, 10**9 + i * 10**8, 0, "c", "hand", 1)
            show = Display(correction="two_pass", stereo="mono", label=f"number {i}")
            writer.write(TOPICS["display"], show, header, 10**9 + i * 10**8)
            reset = EStop(engaged=False, reason="then all was clear")
            writer.write(TOPICS["estop"], reset, header, 10**9 + i * 10**8)
    values = {
        "scene": str(Path("launch/scenes/rigid-plane.yaml").resolve()),
        "nodes": {**GRAPH["nodes"], "fem_solver": {"type": "fem_solver"}},
        "external_topics": ["display"],
        "record": {"bag": "played.mcap"},
    }
    printed = flexsheet("bag", "play", bag, "--start", "0.25", "--launch", write(tmp_path, values))
    assert printed.code == 0, printed.err
    assert "played 3 messages on display" in printed.err
    assert "not started: fem_solver; the scene's object is rigid" in printed.err
    entries = list(BagReader(tmp_path / "played.mcap", ["display", "estop"]))
    shown = [message.label for _, message, _, _ in entries if isinstance(message, Display)]
    assert shown == ["number 2", "number 3", "number 4"]
    # What a person said of an e-stop then, he does not say now.
    assert "tools" not in {header.writer for name, _, header, _ in entries if name == "estop"}
    assert "an e-stop or its reset is not repeated" in printed.err


def test_a_missing_graph_is_reported(
    flexsheet: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(runs.ROOT_VARIABLE, str(tmp_path))
    printed = flexsheet("topic", "echo", "twin/finger")
    assert printed.code == 1
    assert "no graph is running" in printed.err
    bag = write_example(tmp_path / "a.mcap")
    printed = flexsheet("bag", "play", bag)
    assert printed.code == 1
    assert f"start one: flexsheet bag play {bag} --launch replay" in printed.err
    runs.create_run()
    printed = flexsheet("topic", "echo", "twin/finger")
    assert printed.code == 1
    assert "the graph is starting" in printed.err


def test_doctor_examines_the_machine(flexsheet: Command, runs_root: Path) -> None:
    printed = flexsheet("doctor", "--json")
    findings = {finding["check"]: finding for finding in printed.json()}
    assert findings["libraries"]["state"] == "ok"
    assert findings["leftovers"]["state"] == "ok"
    assert printed.code == int(any(one["state"] == "failed" for one in findings.values()))


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"--board": "9by6"}, "expected COLUMNSxROWS"),
        ({"--left": "/nowhere/*.jpg"}, "no file matches"),
        ({"-o": "/nowhere/c.yaml"}, "does not exist"),
    ],
)
def test_wrong_arguments_of_calibrate(
    flexsheet: Command, tmp_path: Path, options: dict[str, str], word: str
) -> None:
    (tmp_path / "left.png").touch()
    given = {
        "--left": str(tmp_path / "left.png"),
        "--right": str(tmp_path / "left.png"),
        "--board": "9x6",
        "--square-mm": "25",
        "-o": str(tmp_path / "c.yaml"),
        **options,
    }
    printed = flexsheet("calibrate", "stereo", *(word for pair in given.items() for word in pair))
    assert printed.code == 2
    assert word in printed.err


def test_calibrating_with_real_images(flexsheet: Command, tmp_path: Path) -> None:
    pictures = ROOT.parent / "shared/data/stereo"
    if not pictures.is_dir():
        pytest.skip("the real stereo pairs are not here")
    given = ("--left", pictures / "left0[1-8].jpg", "--right", pictures / "right0[1-8].jpg",
             "--board", "9x6", "--square-mm", "24.23")  # fmt: skip
    printed = flexsheet("calibrate", "stereo", *given, "-o", tmp_path / "c.yaml", "--json")
    assert printed.code == 0, printed.err
    assert printed.json()["pairs"] >= 5
    given = ("--left", pictures / "left1[0-4].jpg", "--right", pictures / "right1[0-4].jpg",
             "--board", "9x6", "--square-mm", "24.23")  # fmt: skip
    checked = flexsheet(
        "calibrate", "check", "--calibration", tmp_path / "c.yaml", *given, "--json"
    )
    assert checked.code == 0, checked.err
    assert {
        "pairs", "square_rms_mm", "diagonal_rms_mm", "rigid_fit_rms_mm", "reprojection_rms_px",
    } <= checked.json().keys()  # fmt: skip


def test_a_family_is_charted(
    flexsheet: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command measures, draws, writes and prints a family."""
    monkeypatch.setattr("flexsheet.launch.methods.charts.find_family", lambda _: make_family())
    printed = flexsheet("chart", "example", "--output", tmp_path)
    assert printed.code == 0
    assert [line.split()[0] for line in printed.out.splitlines()][:2] == ["method", "good"]
    assert {one.name for one in tmp_path.iterdir()} == {"example.svg", "example.json"}
    found = flexsheet("chart", "example", "--output", tmp_path, "--json").json()
    assert {"family", "unit", "reference", "points", "front"} <= found.keys()
    keys = {"method", "params", "median_s", "p99_s", "error", "in_range"}
    assert all(keys <= point.keys() for point in found["points"])


def test_the_schema_of_scene_files_is_printed(flexsheet: Command) -> None:
    schema = flexsheet("scene").json()
    assert {"object", "sheet", "tolerances"} <= schema["properties"].keys()
