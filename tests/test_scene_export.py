"""Test the URDF model of a scene with independent readers."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from flexsheet.launch.cli import app
from flexsheet.launch.plans.plan import load_scene
from flexsheet.launch.ros2.mapping import list_joints
from flexsheet.launch.viewing.apparatus_model import (
    ApparatusModel,
    make_model,
)
from flexsheet.launch.viewing.urdf import make_urdf
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Side
from flexsheet.nodes.arm_bridge.geometry import ArmGeometry
from tests.rv_1a import JOINT_MAX_RAD, JOINT_MIN_RAD
from tests.scenes import load_cylinder

CYLINDER = load_cylinder()
TOLERANCE_M = 1e-6
SIDES: tuple[Side, ...] = get_args(Side)


def with_offsets(scene: Scene) -> Scene:
    """Return a scene whose encoders deviate from the joints, as a calibration finds."""
    offsets = (0.01, -0.02, 0.015, 0.004, -0.008, 0.02)
    left = scene.arms.left.model_copy(update={"joint_offsets_rad": offsets})
    return scene.model_copy(update={"arms": scene.arms.model_copy(update={"left": left})})


@pytest.fixture(params=["as it is", "with joint offsets"])
def scene(request: pytest.FixtureRequest) -> Scene:
    return CYLINDER if request.param == "as it is" else with_offsets(CYLINDER)


def random_angles(seed: int) -> dict[Side, NDArray[np.float64]]:
    rng = np.random.default_rng(seed)
    return {side: rng.uniform(JOINT_MIN_RAD, JOINT_MAX_RAD) for side in SIDES}


def by_name(angles: dict[Side, NDArray[np.float64]]) -> dict[str, float]:
    return {
        name: float(angle)
        for side in SIDES
        for name, angle in zip(list_joints(side), angles[side], strict=True)
    }


def assert_poses(scene: Scene, poses: Any, angles: dict[Side, NDArray[np.float64]]) -> None:
    """Compare the poses that a reader computed with those of the arm bridge."""
    for side in SIDES:
        geometry = ArmGeometry(scene, side)
        for link, expected in (
            (f"{side}_flange", geometry.world_from_flange(angles[side])),
            (f"{side}_clamp", geometry.world_from_edge(angles[side])),
        ):
            np.testing.assert_allclose(poses(link), expected, atol=TOLERANCE_M, err_msg=link)


def test_yourdfpy_computes_the_same_poses(scene: Scene) -> None:
    yourdfpy = pytest.importorskip("yourdfpy", reason="pip install yourdfpy")
    robot = yourdfpy.URDF.load(io.BytesIO(make_urdf(make_model(scene)).encode()), mesh_dir="")
    assert set(robot.actuated_joint_names) == {*list_joints("left"), *list_joints("right")}
    for seed in range(20):
        angles = random_angles(seed)
        robot.update_cfg(by_name(angles))
        assert_poses(scene, lambda link: robot.get_transform(link, "world"), angles)
    for name in list_joints("left"):
        limit = robot.joint_map[name].limit
        assert limit.lower < limit.upper
        assert limit.velocity > 0.0
    assert robot.scene.geometry


def test_mujoco_computes_the_same_poses(scene: Scene) -> None:
    mujoco = pytest.importorskip("mujoco", reason="pip install mujoco")
    model = mujoco.MjModel.from_xml_string(make_urdf(make_model(scene)))
    data = mujoco.MjData(model)
    for seed in range(20):
        angles = random_angles(seed)
        for name, angle in by_name(angles).items():
            data.joint(name).qpos[0] = angle
        mujoco.mj_kinematics(model, data)

        def pose(link: str) -> NDArray[np.float64]:
            body = data.body(link)
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = body.xmat.reshape(3, 3), body.xpos
            return matrix

        assert_poses(scene, pose, angles)


def test_the_models_of_all_shipped_scenes_have_one_root() -> None:
    for path in sorted(Path("launch/scenes").glob("*.yaml")):
        scene = load_scene(path)
        model: ApparatusModel = make_model(scene)
        children = [joint.child for joint in model.joints]
        assert len(set(children)) == len(children)
        assert {link.name for link in model.links} - set(children) == {"world"}
        assert ("projector" in children) == (scene.projector is not None)


def test_a_model_is_written_or_printed(tmp_path: Path) -> None:
    def run(*words: str | Path) -> Any:
        return CliRunner().invoke(app, ["scene", "cylinder", *map(str, words)])

    printed = run()
    assert printed.exit_code == 0
    done = run("-o", tmp_path / "a.urdf", "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["joints"] == [*list_joints("left"), *list_joints("right")]
    assert printed.stdout == (tmp_path / "a.urdf").read_text()
