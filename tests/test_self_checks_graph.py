"""Run graphs with a changed and an unchanged apparatus, and read which causes the nodes suspect."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from flexsheet.launch.experiments.driver import Driver
from flexsheet.launch.experiments.ports import choose_ports
from flexsheet.launch.experiments.run import run_experiment
from flexsheet.launch.experiments.stroke import stroke_path
from flexsheet.launch.experiments.trial import read_flags
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.apparatus import nominal_apparatus
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Status

ROOT = Path(__file__).parents[1] / "launch"


WAIT_S = 120.0


def suspect(
    folder: Path, strokes_s: list[float], changes: dict[str, dict[str, Any]], *, cause: str = ""
) -> set[str]:
    """Return the causes that nodes suspect during strokes.

    changes: true values by part of the apparatus; those of arms apply to both. cause: suspicion to
    wait for after the strokes, if any.
    """
    scene_file = ROOT / "scenes" / "cylinder.yaml"
    graph = yaml.safe_load((ROOT / "demo.yaml").read_text()) | {"scene": str(scene_file)}
    calibration = str(ROOT / "calibrations" / "twin-bumblebee.yaml")
    graph["nodes"]["triangulator"]["parameters"]["calibration"] = calibration
    (folder / "launch.yaml").write_text(yaml.safe_dump(graph))
    truth = nominal_apparatus(load_scene(scene_file)).model_dump(mode="json")
    for part, values in changes.items():
        for each in truth[part].values() if part == "arms" else [truth[part]]:
            each.update(values)
    (folder / "truth.yaml").write_text(yaml.safe_dump(truth))

    async def procedure(driver: Driver, scene: Scene) -> None:
        def is_reported() -> bool:
            status = driver.newest("status")
            return isinstance(status, Status) and any(
                one.cause == cause and one.suspected for one in status.self_checks
            )

        for duration_s in strokes_s:
            await driver.follow(stroke_path(scene, duration_s))
        if cause:
            await driver.wait_for(is_reported, cause, WAIT_S)

    bag, launch_file = folder / "strokes.mcap", folder / "launch.yaml"
    run_experiment(
        launch_file,
        choose_ports(launch_file),
        bag,
        procedure,
        print,
        apparatus=str(folder / "truth.yaml"),
    )
    return set(read_flags(bag))


@pytest.mark.long
def test_a_longer_servo_lag_is_named_by_the_running_graph(tmp_path: Path) -> None:
    changes = {"arms": {"servo_lag_s": 0.055}}
    assert suspect(tmp_path, [10.0], changes, cause="servo_lag") == {"servo_lag"}


@pytest.mark.long
def test_the_running_graph_raises_no_suspicion_in_ten_minutes(tmp_path: Path) -> None:
    assert suspect(tmp_path, 60 * [10.0], {}) == set()
