"""Test system packages: installed if possible, else named in one line; apt can fail."""

from __future__ import annotations

import shutil
import subprocess
from typing import Any

import pytest

from tests import system_packages as system


class Apt:
    """Substitute for apt-get and its packages; `broken` packages cannot be installed."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *broken: str, root: bool = True) -> None:
        self.commands: list[list[str]] = []
        self.installed: set[str] = set()
        self._broken = broken
        table = (
            self._row("headless OpenGL", "libegl1", tests_only=False),
            self._row("browser tests", "chromium"),
            self._row("window tests", "xvfb"),
        )
        monkeypatch.setattr(system, "TABLE", table)
        monkeypatch.setattr(system, "OPENGL", table[0])
        monkeypatch.setattr(system.os, "geteuid", lambda: 0 if root else 1000)
        monkeypatch.setattr(shutil, "which", lambda *_, **__: "/usr/bin/apt-get")
        monkeypatch.setattr(subprocess, "run", self._run)

    def _row(self, purpose: str, package: str, **options: Any) -> system.SystemPackages:
        def problem() -> str | None:
            return None if package in self.installed else f"no {package}"

        return system.SystemPackages(purpose, (package,), problem, **options)

    def _run(self, command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        self.commands.append(command)
        if any(package in self._broken for package in command):
            return subprocess.CompletedProcess(command, 100)
        if "install" in command:
            self.installed.add(command[-1])
        return subprocess.CompletedProcess(command, 0)


def test_setup_needs_opengl_only(monkeypatch: pytest.MonkeyPatch) -> None:
    apt = Apt(monkeypatch)
    assert system.main([]) == 0
    assert apt.installed == {"libegl1"}


def test_setup_fails_without_opengl(monkeypatch: pytest.MonkeyPatch) -> None:
    apt = Apt(monkeypatch, "libegl1")
    assert system.main([]) == 1
    assert apt.installed == set()


def test_tests_get_everything_and_then_nothing_is_done(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    apt = Apt(monkeypatch)
    assert system.main(["--tests"]) == 0
    assert apt.installed == {"libegl1", "chromium", "xvfb"}
    apt.commands.clear()
    capsys.readouterr()
    assert system.main(["--tests"]) == 0
    assert apt.commands == []
    assert capsys.readouterr().err == ""


def test_a_package_that_cannot_be_had_keeps_out_no_other_and_fails_no_test(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    apt = Apt(monkeypatch, "update", "chromium")
    assert system.main(["--tests"]) == 0
    assert apt.installed == {"libegl1", "xvfb"}
    lines = capsys.readouterr().err.splitlines()
    assert any("chromium failed with exit code 100" in line for line in lines)
    assert lines[-1] == (
        "missing system packages: browser tests (no chromium); "
        "on Debian: sudo apt-get install -y chromium"
    )


def test_without_root_one_line_names_the_packages(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    apt = Apt(monkeypatch, root=False)
    assert system.main(["--tests"]) == 0
    assert apt.commands == []
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("sudo apt-get install -y libegl1 chromium xvfb")


def test_what_is_there_is_found_and_what_is_not_is_named() -> None:
    assert system.find_missing_files(programs=["sh"], libraries=["libc.so.6"]) is None
    found = system.find_missing_files(programs=["no-such-program"], libraries=["libnone.so.9"])
    assert found == "no no-such-program, no libnone.so.9"
