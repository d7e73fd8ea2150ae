"""Test the progress lines and notes that commands print."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from flexsheet.launch.commands import output


def test_progress_is_printed_in_lines_where_stderr_is_no_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = iter((0.0, 1.0, 3.0, 3.0, 6.0, 7.0, 7.0))
    monkeypatch.setattr(output, "time", SimpleNamespace(monotonic=lambda: next(now)))
    with output.progress_bar("replaying") as progress:
        for done in (10, 30, 32, 60):
            progress(done, 100)
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines() == ["replaying: 30 %", "replaying: 60 %"]


def test_a_progress_bar_prints_nothing_in_a_dumb_terminal_if_it_is_short(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TERM", "dumb")
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setattr(output, "words", output.Words())
    assert output.words.console.is_terminal
    with output.progress_bar("detecting the board") as progress:
        progress(1, 2)
    assert capsys.readouterr() == ("", "")
