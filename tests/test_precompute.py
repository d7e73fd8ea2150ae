"""Test the command `flexsheet precompute`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from flexsheet.launch import cli
from flexsheet.launch.plans.plan import load_scene
from flexsheet.nodes.fem_solver import body, precompute_table, snapshots, soft_body_factory
from flexsheet.nodes.fem_solver.mesh import cylinder
from tests.scenes import load_values
from tests.soft_bodies import InlineExecutor

SPACING_M = 0.005


@pytest.fixture
def scene_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write a scene of a small cylinder with small pushes on a coarse mesh."""
    monkeypatch.setattr(snapshots, "DEPTHS_M", (0.0015, 0.002, 0.0025, 0.003))
    monkeypatch.setattr(snapshots, "COARSE_DEPTHS_M", (0.0015, 0.003))
    monkeypatch.setattr(snapshots, "FINE_DEPTHS_M", (0.0015, 0.003))
    monkeypatch.setattr(snapshots, "FINE_RATIO", 1.0)
    monkeypatch.setattr(snapshots, "SPACING_RATIO", 1.0)
    monkeypatch.setattr(snapshots, "STATIONS", (0.0,))
    monkeypatch.setattr(snapshots, "ANGLE_STEP_RAD", 2.0)
    monkeypatch.setattr(cylinder, "FOCUS_GROWTH", 0.8)
    monkeypatch.setattr(
        "flexsheet.launch.running.precompute.precompute_deflection_shapes",
        lambda scene, cache, progress: cache,
    )
    # other processes take seconds to start
    monkeypatch.setattr(
        soft_body_factory, "local_processes", lambda count: nullcontext(InlineExecutor())
    )
    content = load_values()
    content["object"]["geometry"] |= {"radius_m": 0.02, "length_m": 0.05}
    content["object"]["world_from_object"]["position_m"] = [0.0, 0.0, -0.02]
    content["working_range"]["push_depth_m"] = 0.03
    content["methods"] = {"soft_body": {"method": "nonlinear_table", "skin_spacing_m": SPACING_M}}
    path = tmp_path / "small.yaml"
    YAML().dump(content, path)
    return path


@pytest.fixture
def flexsheet(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str]]:
    """Return a function that runs the command and returns its exit code and its output."""

    def run(*arguments: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["flexsheet", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            cli.main()
        return int(end.value.code or 0), " ".join(capsys.readouterr().err.split())

    return run


@pytest.mark.parametrize("options", [(), ("--complete-table",)])
def test_the_table_is_computed_once_in_the_nodes_cache(
    scene_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    flexsheet: Callable[..., tuple[int, str]],
    options: tuple[str, ...],
) -> None:
    arguments = ("precompute", scene_file, "--cache", tmp_path / "cache", *options)
    code, printed = flexsheet(*arguments)
    assert code == 0
    assert "computing the soft body (only once): 0 %" in printed
    assert "100 %" in printed
    scene = load_scene(scene_file)
    spec = body.make_table_spec(
        scene, body.make_soft_body_spec(scene, SPACING_M), coarse=not options
    )
    path = precompute_table.make_table_cache(spec).path(tmp_path / "cache")
    assert path.exists()
    assert path.name in printed.replace(" ", "")
    made = path.stat().st_mtime_ns
    monkeypatch.setattr(soft_body_factory, "local_processes", pytest.fail)
    assert flexsheet(*arguments)[0] == 0
    assert path.stat().st_mtime_ns == made


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--scheduler", "tcp://127.0.0.1:9"), "add --complete-table"),
        (
            ("--complete-table", "--scheduler", "tcp://127.0.0.1:9"),
            'no scheduler answers at "tcp://127.0.0.1:9"',
        ),
    ],
)
def test_impossible_requests_are_rejected_with_an_error_text(
    scene_file: Path,
    tmp_path: Path,
    flexsheet: Callable[..., tuple[int, str]],
    options: tuple[str, ...],
    named: str,
) -> None:
    code, printed = flexsheet("precompute", scene_file, "--cache", tmp_path, *options)
    assert code == 2
    assert named in printed.replace("│ ", "").replace(" │", "")
    assert "Traceback" not in printed
