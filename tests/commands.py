"""Run the `flexsheet` command in the process of a test."""

from __future__ import annotations

import json
import sys
from typing import Any, NamedTuple

import pytest

from flexsheet.launch import cli


class CommandResult(NamedTuple):
    """The exit code and the output of a command."""

    code: int
    out: str
    err: str

    def json(self) -> Any:
        return json.loads(self.out)


class Command:
    """A runner of the command in this process; the fixture `flexsheet` makes it."""

    def __init__(self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
        self._capsys, self._monkeypatch = capsys, monkeypatch

    def __call__(self, *arguments: object) -> CommandResult:
        self._monkeypatch.setattr(sys, "argv", ["flexsheet", *map(str, arguments)])
        self._capsys.readouterr()
        with pytest.raises(SystemExit) as end:
            cli.main()
        out, err = self._capsys.readouterr()
        return CommandResult(int(end.value.code or 0), out, err)
