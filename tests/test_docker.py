"""Test compose files and the systemd unit without running them."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from flexsheet.launch.plans.plan import load_graph

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
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not here")
    text = (ROOT / "launch" / "systemd" / "flexsheet@.service").read_text()
    # systemd checks that the program and the user exist.
    for installed, here in (
        ("/opt/flexsheet/.venv/bin/flexsheet", sys.executable),
        ("User=flexsheet", "User=root"),
        ("Group=flexsheet", "Group=root"),
    ):
        assert installed in text
        text = text.replace(installed, here)
    unit = tmp_path / "flexsheet@.service"
    unit.write_text(text)
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(unit)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
