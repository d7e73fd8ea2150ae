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
from tests.test_check_marks import PLACES

ROOT = Path(__file__).parents[1] / "launch"


MARKS_CAUSE = "camera_or_projector_moved"
WAIT_S = 120.0


def suspect(
    folder: Path, strokes_s: list[float], changes: dict[str, dict[str, Any]], *, cause: str = ""
) -> set[str]:
    """Return the causes that nodes suspect during strokes with projected marks.

    changes: true values by part of the apparatus; those of arms apply to both. cause: suspicion to
    wait for after the strokes, if any.
    """
    scene_file = yaml.safe_load((ROOT / "scenes" / "cylinder.yaml").read_text())
    scene_file["projector"]["check_marks_sheet_m"] = [list(place) for place in PLACES]
    (folder / "scene.yaml").write_text(yaml.safe_dump(scene_file))
    graph = yaml.safe_load((ROOT / "demo.yaml").read_text()) | {"scene": "scene.yaml"}
    calibration = str(ROOT / "calibrations" / "twin-bumblebee.yaml")
    graph["nodes"]["triangulator"]["parameters"]["calibration"] = calibration
    (folder / "launch.yaml").write_text(yaml.safe_dump(graph))
    truth = nominal_apparatus(load_scene(folder / "scene.yaml")).model_dump(mode="json")
    for part, values in changes.items():
        for each in truth[part].values() if part == "arms" else [truth[part]]:
            each.update(values)
    (folder / "truth.yaml").write_text(yaml.safe_dump(truth))

    async def procedure(driver: Driver, scene: Scene) -> None:
        def reports(wanted: str, *, suspected: bool) -> bool:
            status = driver.newest("status")
            return isinstance(status, Status) and any(
                one.cause == wanted and one.suspected >= suspected for one in status.self_checks
            )

        await driver.wait_for(
            lambda: reports(MARKS_CAUSE, suspected=False), "projected marks", WAIT_S
        )
        for duration_s in strokes_s:
            await driver.follow(stroke_path(scene, duration_s))
        if cause:
            await driver.wait_for(lambda: reports(cause, suspected=True), cause, WAIT_S)

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
@pytest.mark.parametrize(
    ("changes", "strokes_s", "cause"),
    [
        ({"projector": {"position_offset_m": [0.0, 0.003, 0.0]}}, [], MARKS_CAUSE),
        ({"arms": {"base_position_offset_m": [0.0, 0.0, -0.003]}}, [], "camera_or_arm_base_moved"),
        ({"arms": {"servo_lag_s": 0.055}}, [10.0], "servo_lag"),
    ],
)
def test_a_changed_apparatus_is_named_by_the_running_graph(
    tmp_path: Path, changes: dict[str, dict[str, Any]], strokes_s: list[float], cause: str
) -> None:
    assert suspect(tmp_path, strokes_s, changes, cause=cause) == {cause}


@pytest.mark.long
def test_the_running_graph_raises_no_suspicion_in_ten_minutes(tmp_path: Path) -> None:
    assert suspect(tmp_path, 60 * [10.0], {}) == set()
