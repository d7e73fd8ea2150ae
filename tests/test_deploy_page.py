"""Test the parsing of docs/deploy.md for `make deploy-trial`, and the evaluation of following."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.deploy_trial import HOSTS, PAGE, Stroke, evaluate_stroke, steps
from flexsheet.launch.commands.systemd import install
from flexsheet.messages.bag import BagWriter
from tests.doc_pages import ROOT

LAB = ROOT / "launch" / "lab.yaml"


def test_the_page_gives_host_and_exit_code_of_each_command() -> None:
    found = list(steps(PAGE.read_text()))
    typed = [one.command for one in found]
    for part in ("keys new", "keys install", "launch", "doctor hosts", "arms enable", "^C"):
        assert any(part in command for command in typed), part
    assert {one.hosts for one in found} == {HOSTS, ("main",), ("left",)}
    assert [one.command.split("#")[0].strip() for one in found if one.code] == [
        "flexsheet arms enable"
    ]


def test_a_line_without_a_prompt_is_rejected() -> None:
    with pytest.raises(ValueError, match="line 2 has no prompt"):
        list(steps("```console\nflexsheet doctor\n```\n"))


def test_a_resting_arm_has_not_followed() -> None:
    good = Stroke(seconds=10.0, following=1.0, apart_m=0.001, travel_m=0.03)
    stood = Stroke(seconds=10.0, following=0.1, apart_m=np.inf, travel_m=0.0)
    assert good.problems() == []
    assert len(stood.problems()) == 3


def test_a_bag_without_a_stroke_is_no_proof(tmp_path: Path) -> None:
    bag = tmp_path / "nothing.mcap"
    BagWriter(bag).close()
    with pytest.raises(ValueError, match="contains no stroke"):
        evaluate_stroke(bag)


def test_a_bag_that_the_service_cannot_write_is_reported(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    install(launch_file=LAB, host="main", root=tmp_path, dry_run=True)
    assert "can write only to /var/lib/flexsheet" in " ".join(capfd.readouterr().err.split())
    install(launch_file=LAB, host="left", root=tmp_path, dry_run=True)
    assert capfd.readouterr().err == ""
