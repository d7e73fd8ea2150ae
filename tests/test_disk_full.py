"""Test that a command on a full disk prints one line, and leaves no incomplete file."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from flexsheet.messages.bag import BagError, BagWriter
from flexsheet.messages.files import FileWriteError, free_bytes, write_file
from tests.sessions import write_session
from tests.test_cli import Command
from tests.test_recorder import small_disk

__all__ = ["small_disk"]


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Command:
    return Command(capsys, monkeypatch)


def fill(disk: Path) -> None:
    """Fill the disk completely."""
    with (disk / "filler").open("wb", buffering=0) as file:
        try:
            while file.write(bytes(1 << 16)):
                pass
        except OSError:
            return


LAUNCH = (
    "hosts: {main: {address: 127.0.0.1}}\nnodes: {arms: {type: twin_arms, topics: {scene: null}}}\n"
)
KEY = "rq:rM>}U?@Lns47E1%kR.o@n%FcmmsL/@{H8]yf7"

COMMANDS = {
    "keys": "keys left",
    "keys --install": "keys main --install {disk}/graph.yaml --key {key}",
    "bag export": "bag export {bag} -o {disk}/out.mcap",
    "bag export --format bag": "bag export {bag} -o {disk}/out.mcap --format bag",
    "bag report": "bag report {bag} -o {disk}/out.html",
    "launch": "launch {disk}/graph.yaml",
}


@pytest.mark.parametrize("name", list(COMMANDS))
def test_one_line_and_no_file(
    name: str,
    command: Command,
    small_disk: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("FLEXSHEET_KEYS", str(small_disk / "keys"))
    monkeypatch.setenv("FLEXSHEET_RUNS", str(small_disk / "runs"))
    (small_disk / "keys").mkdir()
    (small_disk / "runs").mkdir()
    (small_disk / "graph.yaml").write_text(LAUNCH)
    bag = tmp_path / "a.mcap"
    write_session(bag)
    fill(small_disk)
    before = {path for path in small_disk.rglob("*") if path.is_file()}
    result = command(*COMMANDS[name].format(disk=small_disk, bag=bag, key=KEY).split())
    assert result.code not in (0, None)
    assert "Traceback" not in result.err
    assert "No space left on device" in result.err
    assert "free" in result.err
    assert str(small_disk) in result.err
    assert {path for path in small_disk.rglob("*") if path.is_file()} == before
    assert (small_disk / "graph.yaml").read_text() == LAUNCH


def test_a_file_is_replaced_whole_or_not_at_all(small_disk: Path) -> None:
    file = small_disk / "a.yaml"
    write_file(file, "first")
    fill(small_disk)
    with pytest.raises(FileWriteError, match=r"a\.yaml: .*0\.20 MB are needed, .* are free"):
        write_file(file, bytes(200_000))
    assert file.read_text() == "first"
    assert sorted(path.name for path in small_disk.iterdir()) == ["a.yaml", "filler"]
    assert free_bytes(small_disk) < 1 << 16


def test_a_file_has_its_permissions_from_the_start(tmp_path: Path) -> None:
    write_file(tmp_path / "a", "x", mode=0o600)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o600
    assert os.listdir(tmp_path) == ["a"]


def test_no_empty_bag_is_left(small_disk: Path) -> None:
    fill(small_disk)
    with pytest.raises(BagError, match="No space left"):
        BagWriter(small_disk / "a.mcap")
    assert not (small_disk / "a.mcap").exists()
