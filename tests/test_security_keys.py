"""Test key pairs: files, command, launch file, and graphs with keys."""

from __future__ import annotations

import os
import random
import string
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq

from flexsheet.launch.plans.documents import BadInputError, read_document
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.launch.running import runs
from flexsheet.launch.running.keys import KEYS_VARIABLE, install
from flexsheet.launch.running.supervisor import RunningGraph
from flexsheet.launch.running.tools import make_subscriber
from flexsheet.messages.security import (
    SecurityError,
    derive_public_key,
    is_key,
    make_key_pair,
    read_secret,
    write_secret,
)
from flexsheet.messages.types import TwinFinger
from tests.test_cli import Command
from tests.test_launch_supervisor import LISTENER, beacon, write
from tests.waiting import DEADLINE_S, until

# Of this process's own: ports follow from names, and tests may run beside each other.
NET = f"127.{1 + os.getpid() % 250}.{os.getpid() // 250 % 250}"
HOSTS = {"main": {"address": f"{NET}.1"}, "left": {"address": f"{NET}.2"}}
LAB = """\
# the lab
hosts:
  main: {address: 192.0.2.10}   # upstairs
  left:
    address: 192.0.2.11
nodes:
  beacon: {type: "tests.launch_nodes:Beacon"}
"""


@pytest.fixture(autouse=True)
def runs_root(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Create a directory for runs, with a short path."""
    with tempfile.TemporaryDirectory(prefix="fs-", dir="/tmp") as folder:
        monkeypatch.setenv(runs.ROOT_VARIABLE, folder)
        yield


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Command:
    return Command(capsys, monkeypatch)


@pytest.fixture(autouse=True)
def keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "keys"
    monkeypatch.setenv(KEYS_VARIABLE, str(folder))
    return folder


def make(folder: Path, host: str, *, replace: bool = False) -> str:
    public, secret = make_key_pair()
    write_secret(folder / f"{host}.secret", secret, replace=replace)
    return public


def test_a_secret_is_for_its_owner_alone(keys: Path) -> None:
    public = make(keys, "main")
    file = keys / "main.secret"
    assert (file.stat().st_mode & 0o777, keys.stat().st_mode & 0o777) == (0o600, 0o700)
    assert derive_public_key(read_secret(file)) == public
    with pytest.raises(SecurityError, match="exists already; --replace"):
        make(keys, "main")
    assert derive_public_key(read_secret(file)) == public
    assert make(keys, "main", replace=True) == derive_public_key(read_secret(file)) != public
    assert sorted(path.name for path in keys.iterdir()) == ["main.secret"]


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o622])
def test_a_secret_that_others_may_read_is_not_used(keys: Path, mode: int) -> None:
    make(keys, "main")
    file = keys / "main.secret"
    file.chmod(mode)
    with pytest.raises(SecurityError, match=f"other users may read it .mode {mode:04o}.*chmod 600"):
        read_secret(file)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file away")
def test_a_secret_of_another_user_is_not_used(keys: Path) -> None:
    make(keys, "main")
    os.chown(keys / "main.secret", 12345, -1)
    with pytest.raises(SecurityError, match="belongs to another user"):
        read_secret(keys / "main.secret")


@pytest.mark.parametrize("text", ["", "x" * 39, "x" * 41, "é" * 40, "~" * 40, "x" * 5000])
def test_an_invalid_key_is_reported(keys: Path, text: str) -> None:
    make(keys, "main")
    (keys / "main.secret").write_text(text)
    with pytest.raises(SecurityError, match="does not contain a key"):
        read_secret(keys / "main.secret")
    assert not is_key(text)


@pytest.mark.parametrize("first", ".-:+=^!/*?&<>()[]{}@%0")
def test_any_key_can_stand_in_a_launch_file(tmp_path: Path, first: str) -> None:
    """Keys can contain characters with a special meaning in YAML."""
    file = tmp_path / "graph.yaml"
    file.write_text(
        'nodes: {beacon: {type: "tests.launch_nodes:Beacon"}}\n'
        "hosts: {main: {address: 127.0.0.1}}\n"
    )
    key = f"{first}0000{ONE[5:]}"
    install(file, "main", key)
    install(file, "main", key)
    assert load_graph(file).keys == {"main": key}


def test_no_new_public_key_looks_like_an_option(monkeypatch: pytest.MonkeyPatch) -> None:
    pairs = iter([(b"-" + ONE[1:].encode(), b"first"), (ONE.encode(), b"second")])
    monkeypatch.setattr(zmq, "curve_keypair", lambda: next(pairs))
    assert make_key_pair() == (ONE, "second")


@pytest.mark.parametrize("key", ["-h=j" + "0" * 36, "--js" + "0" * 36, "-" + "0" * 39])
@pytest.mark.parametrize("order", ["main --install {file} --key {key}",
                                   "main --install {file} --key={key} --json"])  # fmt: skip
def test_a_key_that_looks_like_an_option_is_installed(
    tmp_path: Path, command: Command, key: str, order: str
) -> None:
    assert is_key(key)
    file = tmp_path / "graph.yaml"
    file.write_text(LAB)
    result = command("keys", *order.format(file=file, key=key).split())
    assert result.code == 0, result
    assert read_document(file).values["hosts"]["main"]["key"] == key


def test_install_changes_one_key_and_nothing_else(tmp_path: Path) -> None:
    file = tmp_path / "lab.yaml"
    file.write_text(LAB)
    chance = random.Random(5)
    # All of Z85; any five of them are four bytes, if not too large.
    characters = string.digits + string.ascii_letters + ".-:+=^!/*?&<>()[]{}@%$#"
    keys_tried = [make_key_pair()[0] for _ in range(30)]
    keys_tried += [
        key
        for _ in range(2000)
        if is_key(key := "".join(chance.choices(characters, k=40)))
    ][:100]  # fmt: skip
    assert len(keys_tried) == 130
    install(file, "left", keys_tried[0])
    for key in keys_tried[1:]:
        install(file, "main", key)
        assert load_graph(file).keys == {"main": key, "left": keys_tried[0]}
    text = file.read_text()
    assert "# the lab" in text
    assert "# upstairs" in text
    for host, key, printed in (
        ("lft", keys_tried[0], 'no host "lft"; did you mean "left"'),
        ("left", "nonsense", '"nonsense" is not a public key'),
    ):
        with pytest.raises(BadInputError, match=printed):
            install(file, host, key)


def test_keys_are_no_part_of_the_plan_s_hash(tmp_path: Path) -> None:
    hashes = set()
    for _ in range(2):
        given = {name: {**host, "key": make_key_pair()[0]} for name, host in HOSTS.items()}
        hashes.add(load_graph(write(tmp_path, {"beacon": beacon()}, hosts=given)).hash)
    hashes.add(load_graph(write(tmp_path, {"beacon": beacon()}, hosts=HOSTS)).hash)
    assert len(hashes) == 1
    given = {**HOSTS, "left": {**HOSTS["left"], "may_reset_estop": True}}
    hashes.add(load_graph(write(tmp_path, {"beacon": beacon()}, hosts=given)).hash)
    assert len(hashes) == 2


ONE, TWO = make_key_pair()[0], make_key_pair()[0]


@pytest.mark.parametrize(
    ("main", "left", "printed"),
    [
        (
            ONE,
            None,
            "hosts.left: the host has no key, but other hosts have one; create one on that host",
        ),
        (
            ONE,
            ONE,
            'hosts.left.key: the same key belongs to host "main"; create a separate key for',
        ),
        (ONE, "secret", 'hosts.left.key: "secret" is not a public key'),
    ],
    ids=["one without", "two alike", "no key"],  # keys are redrawn; names of tests must not be
)
def test_keys_that_do_not_do(tmp_path: Path, main: str, left: str | None, printed: str) -> None:
    given = {"main": {**HOSTS["main"], "key": main}, "left": {**HOSTS["left"], "key": left}}
    with pytest.raises(BadInputError, match=printed):
        load_graph(write(tmp_path, {"beacon": beacon()}, hosts=given))


def test_an_arm_s_own_protocol_does_not_cross_the_network(tmp_path: Path) -> None:
    given = {"main": {"address": "192.0.2.1"}, "left": {"address": "192.0.2.2"}}
    twin = {"type": "twin_arms", "parameters": {"host": "192.0.2.2"}, "topics": {"scene": None}}
    with pytest.raises(BadInputError, match=r"parameters.host: .*192.0.2.2 is not a loopback"):
        load_graph(write(tmp_path, {"twin": twin}, hosts=given))
    bridge = {
        "type": "arm_bridge",
        "parameters": {"side": "left", "host": "192.0.2.2"},
        "topics": {"arm": "arm_left", "other_arm": None, "sheet_target": None, "scene": None},
    }
    with pytest.raises(
        BadInputError, match=r'192.0.2.2 is the address of host "left".*run bridge on that host'
    ):
        load_graph(write(tmp_path, {"bridge": bridge}, hosts=given))
    bridge["host"] = "left"
    load_graph(write(tmp_path, {"bridge": bridge}, hosts=given))


def test_the_command_makes_shows_and_installs(command: Command, keys: Path, tmp_path: Path) -> None:
    made = command("keys", "left", "--json").json()
    assert made["secret_file"] == str(keys / "left.secret")
    assert command("keys", "left").out.strip() == made["public"]
    file = tmp_path / "lab.yaml"
    file.write_text(LAB)
    assert command("keys", "left", "--install", file).code == 0
    assert command("keys", "main", "--install", file, "--key", ONE).code == 0
    assert load_graph(file).keys == {"left": made["public"], "main": ONE}
    (keys / "left.secret").chmod(0o644)
    shown = command("keys", "left")
    assert (shown.code, "other users may read it" in shown.err) == (1, True)
    assert command("keys", "left", "--replace").out.strip() != made["public"]
    assert command("keys", "Left Arm").code == 2


async def inbox(plan: ResolvedGraph, graph: RunningGraph) -> None:
    """Wait until a tool on the host `main` has received a message from the host `left`."""
    fingers: list[TwinFinger] = []
    printed: list[str] = []
    subscriber = make_subscriber(
        "twin/finger", plan, graph.run, lambda message, _: fingers.append(message),
        on_problem=printed.append,
    )  # fmt: skip
    subscriber.start()
    try:
        await until(lambda: len(fingers) > 5)
    finally:
        subscriber.close()


def plan_with_keys(folder: Path, public: dict[str, str], **more: Any) -> ResolvedGraph:
    given = {name: {**host, "key": public[name]} for name, host in HOSTS.items()}
    nodes = {"beacon": beacon(host="left"), "listener": LISTENER}
    return load_graph(write(folder, nodes, hosts=given, **more))


async def test_a_graph_with_keys_and_a_new_key_after_a_restart(tmp_path: Path, keys: Path) -> None:
    public = {name: make(keys, name) for name in HOSTS}
    plan = plan_with_keys(tmp_path, public)

    async def check(plan: ResolvedGraph) -> None:
        async with RunningGraph(plan, host="main") as main, RunningGraph(plan, host="left") as left:
            await main.wait_ready(DEADLINE_S)
            await left.wait_ready(DEADLINE_S)
            await inbox(plan, main)

    await check(plan)
    install(Path(plan.launch_file), "left", make(keys, "left", replace=True))
    await check(load_graph(Path(plan.launch_file)))


async def test_a_host_without_its_secret_does_not_start(tmp_path: Path, keys: Path) -> None:
    public = {name: make(keys, name) for name in HOSTS}
    plan = plan_with_keys(tmp_path, public)
    make(keys, "left", replace=True)
    with pytest.raises(BadInputError, match="does not match the key of host"):
        await RunningGraph(plan, host="left").__aenter__()
    (keys / "left.secret").unlink()
    with pytest.raises(BadInputError, match="does not exist; create a key: flexsheet keys left"):
        await RunningGraph(plan, host="left").__aenter__()
