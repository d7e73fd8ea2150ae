"""Test compose files and the systemd unit without running them."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML
from typer.testing import CliRunner

from flexsheet.launch.cli import app
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.running.systemd import make_files

ROOT = Path(__file__).resolve().parent.parent
DOCKER = ROOT / "docker"
HOSTS = ("main", "left", "right")
LAUNCH_FILES = {"three": "three.yaml", **dict.fromkeys(HOSTS, "lab.yaml")}


def services(name: str) -> dict[str, Any]:
    values = YAML(typ="safe").load(DOCKER / f"compose.{name}.yaml")
    assert set(values) <= {"services", "volumes", "networks", "x-host"}
    for service in values["services"].values():
        given = [re.sub(r"\$\{\w+:-(.*?)\}", r"\1", one) for one in service["volumes"]]
        mounted = [one.split(":")[0] for one in given]
        named = {one for one in mounted if re.fullmatch(r"\w+", one)}
        assert named <= set(values["volumes"]), "a volume that is mounted is declared"
        for source in mounted:
            made_later = source.startswith(("./keys/", "../runs"))
            assert source in named or made_later or (DOCKER / source).exists(), source
    found: dict[str, Any] = values["services"]
    return found


@pytest.mark.parametrize("name", LAUNCH_FILES)
def test_each_host_has_a_container_that_ends_in_order_and_remembers(name: str) -> None:
    found = services(name)
    assert set(found) == (set(HOSTS) if name == "three" else {name})
    plan = load_graph(ROOT / "launch" / LAUNCH_FILES[name])
    for host, service in found.items():
        *_, file, option, value = service["command"]
        assert (Path(file).name, option, value) == (LAUNCH_FILES[name], "--host", host)
        assert service["init"]
        assert service["stop_signal"] == "SIGINT"
        assert service["stop_grace_period"] == "25s"
        assert "state:/var/lib/flexsheet" in service["volumes"]
        assert f"./keys/{host}" in " ".join(service["volumes"])
        if name == "three":
            assert service["networks"]["lab"]["ipv4_address"] == plan.hosts[host]
        else:
            assert service["network_mode"] == "host"
            devices = [one for one in service.get("devices", []) if "video" in one]
            text = str([node.parameters for node in plan.nodes_on(host)])
            assert devices == sorted(set(re.findall(r"/dev/video\d+", text)))


def test_the_unit_is_one_that_systemd_understands(tmp_path: Path) -> None:
    lab = ROOT / "launch" / "lab.yaml"
    made = list(make_files(launch_file=lab, host="left", user="root", root=tmp_path))
    assert "FLEXSHEET_STATE=/var/lib/flexsheet" in made[0].text
    assert not re.search("@[A-Z]+@", made[0].text)
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not here")
    for file in made:
        file.path.parent.mkdir(parents=True, exist_ok=True)
        file.path.write_text(file.text)
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(made[0].path)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")


def test_packages_in_the_json_output_are_installed_too(tmp_path: Path) -> None:
    done = CliRunner().invoke(
        app,
        ["service", "install", str(ROOT / "launch" / "three.yaml"), "--host", "left",
         "--root", str(tmp_path), "--json"],
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    reported = {Path(one["path"]): one["text"] for one in json.loads(done.stdout)}
    assert {path.name for path in reported} == {
        "flexsheet@.service", "90-flexsheet.conf", "left.env"
    }  # fmt: skip
    assert {path: path.read_text() for path in reported} == reported
