"""Test the warning of `flexsheet systemd` about bags that the service cannot write."""

from __future__ import annotations

from pathlib import Path

import pytest

from flexsheet.launch.commands.systemd import install
from tests.doc_pages import ROOT

LAB = ROOT / "launch" / "lab.yaml"


def test_a_bag_that_the_service_cannot_write_is_reported(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    install(launch_file=LAB, host="main", root=tmp_path, dry_run=True)
    assert "can write only to /var/lib/flexsheet" in " ".join(capfd.readouterr().err.split())
    install(launch_file=LAB, host="left", root=tmp_path, dry_run=True)
    assert capfd.readouterr().err == ""
