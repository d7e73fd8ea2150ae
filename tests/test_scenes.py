"""The scenes that come with the project: each loads, is within the arms' reach, and is touched."""

from __future__ import annotations

from functools import lru_cache
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.organ import obj_text, organ_mesh
from flexsheet.launch.experiments import ExperimentError
from flexsheet.launch.experiments.finger_paths import gesture_path
from flexsheet.launch.health.layout import check_layout
from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.scene import Scene
from flexsheet.nodes.models.rigid import angle_between, apply, inverse, transform_from_rpy
from flexsheet.nodes.models.shapes import make_shape
from flexsheet.nodes.planner.node import Planner
from flexsheet.nodes.twin.finger import FingerPathError, SmoothPath
from flexsheet.nodes.twin.gestures import GESTURES
from flexsheet.nodes.twin.paths import map_to_surface, touchable
from tests import test_arm_loop as arm_loop
from tests.examples import long_except
from tests.plans import STEP_S, PlannerHarness, scene_with
from tests.waiting import until

Floats = NDArray[np.float64]
SCENES = Path(__file__).resolve().parent.parent / "launch" / "scenes"
NAMES = ("cylinder", "sphere", "ellipsoid", "plane", "box", "organ", "rigid-plane")
TUNED = ("light-touch", "palpation", "demanding")
"""One of the above each, with another working range, other tolerances, or methods chosen."""
ROUND = ("sphere", "ellipsoid", "box", "organ")
BOTH = ("box",)
"""Scenes whose sheet both arms carry in `make test`."""


@lru_cache
def scene(name: str) -> Scene:
    return load_scene(SCENES / f"{name}.yaml")


def object_pose(of: Scene) -> Floats:
    pose = of.object.world_from_object
    return transform_from_rpy(pose.position_m, pose.rpy_rad)


def test_every_scene_is_tested() -> None:
    assert {path.stem for path in SCENES.glob("*.yaml")} == {*NAMES, *TUNED}


def test_the_organs_file_is_what_its_maker_makes() -> None:
    assert (SCENES / "organ.obj").read_text() == obj_text(*organ_mesh())


@pytest.mark.parametrize("name", long_except(["plane", "organ"], "plane"))
def test_the_arms_reach_the_whole_working_range(name: str) -> None:
    layout = check_layout(scene(name))
    assert layout.reachable
    assert layout.followed.mean() > 0.99


@pytest.mark.parametrize("name", NAMES)
def test_the_front_touches_the_imaginary_screen_and_points_are_on_geodesics(name: str) -> None:
    here = scene(name)
    front = map_to_surface(here, np.zeros((1, 3)))[0]
    assert front == pytest.approx(np.zeros(3), abs=1.5e-3)
    along_m, arc_m = touchable(here)
    assert 0.02 < along_m < 0.2
    assert 0.02 < arc_m <= 2.0 * here.sheet.usable_half_height_m
    # Around the surface a millimetre is a millimetre, and at the ends the tilt is not exceeded.
    arcs = np.linspace(-0.5 * arc_m, 0.5 * arc_m, 400)
    points = map_to_surface(here, np.column_stack([0 * arcs, arcs, 0 * arcs]))
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert steps == pytest.approx(np.diff(arcs), rel=2e-3)
    shape, world_from_object = make_shape(dict(here.object.geometry)), object_pose(here)
    found = shape.closest(apply(inverse(world_from_object), points))
    assert np.abs(found.height_m).max() < 1e-6
    leans = np.arccos(np.clip(found.normal @ world_from_object[:3, :3].T[:, 2], -1.0, 1.0))
    assert leans.max() < here.working_range.tilt_rad + 0.02


def test_on_a_cylinder_and_a_sphere_points_have_a_closed_form() -> None:
    rng = np.random.default_rng(0)
    places = rng.uniform([-0.025, -0.025, -0.005], [0.025, 0.025, 0.03], (200, 3))
    along, arc, height = places.T
    radius = 0.0353553
    angle, reach = arc / radius, radius + height
    wanted = np.column_stack([along, reach * np.sin(angle), reach * np.cos(angle) - radius])
    assert map_to_surface(scene("cylinder"), places) == pytest.approx(wanted, abs=1e-7)
    radius = 0.05
    out = np.column_stack(
        [
            np.sin(along / radius) * np.cos(arc / radius),
            np.sin(arc / radius),
            np.cos(along / radius) * np.cos(arc / radius),
        ]
    )
    wanted = (radius + height)[:, None] * out - [0.0, 0.0, radius]
    assert map_to_surface(scene("sphere"), places) == pytest.approx(wanted, abs=1e-7)


def test_an_object_that_turns_no_side_to_the_user_has_no_path() -> None:
    plane = {"shape": "plane", "width_m": 0.2, "height_m": 0.2}
    with pytest.raises(FingerPathError, match="no side of the object faces the user"):
        touchable(scene_with(plane, rpy_rad=(2.0, 0.0, 0.0)))


def test_an_object_that_is_turned_is_met_at_its_middle() -> None:
    """Where the point nearest to the user is an end, what he sees through the middle counts."""
    plane = {"shape": "plane", "width_m": 0.1, "height_m": 0.1}
    turned = scene_with(plane, (0.0, 0.0, -0.01), (0.4, 0.0, 0.0))
    assert map_to_surface(turned, np.zeros((1, 3)))[0] == pytest.approx([0.0, 0.0, -0.01], abs=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_every_gesture_can_be_made_on_every_scene(name: str) -> None:
    here = scene(name)
    shape, object_from_world = make_shape(dict(here.object.geometry)), inverse(object_pose(here))
    for gesture, make in GESTURES.items():
        path = make(here)
        points = path.positions_world_m
        assert (points >= here.finger.volume_min_m).all()
        assert (points <= here.finger.volume_max_m).all()
        speeds = SmoothPath.through(path.times_s, points).speeds()
        assert speeds.max() <= here.finger.max_speed_m_per_s
        heights = shape.closest(apply(object_from_world, points[::5])).height_m
        if gesture == "hover":
            assert heights.min() > 0.01
        else:
            assert -0.0065 < heights.min() < -0.0009


def test_the_papers_stroke_is_rejected_where_there_is_no_cylinder() -> None:
    with pytest.raises(ExperimentError, match=r'scene "sphere": object\.geometry\.shape'):
        gesture_path("stroke-10", scene("sphere"))


FOLLOWED = {
    ("circle", "plane"), ("circle", "sphere"), ("stroke-push", "cylinder"),
    ("stroke-push", "organ"),
}  # fmt: skip
"""Cases that `make test` runs for a third of the gesture: solids and a mesh."""


@pytest.mark.parametrize(
    ("gesture", "name", "share"),
    [
        *((*pair, 1 / 3) for pair in sorted(FOLLOWED)),
        *(
            pytest.param(*pair, 1.0, marks=pytest.mark.long)
            for pair in product(("circle", "stroke-push"), NAMES)
        ),
    ],
)
def test_the_planner_follows_gestures_on_every_scene(gesture: str, name: str, share: float) -> None:
    """In touch all the way, the sheet bounded, its normal that of the surface under the finger.

    At the 25 mm/s that the sheet can follow everywhere.  Who goes round and round turns it about
    its normal by the solid angle; that is said when it is too much.

    share: of the gesture's duration.  A third of "stroke-push" is one stroke in each direction.
    """
    here = scene(name)
    path = GESTURES[gesture](here)
    fastest = float(SmoothPath.through(path.times_s, path.positions_world_m).speeds().max())
    motion = SmoothPath.through(path.times_s * (fastest / 0.025), path.positions_world_m)
    times = np.arange(0.0, share * motion.duration_s, STEP_S)
    desk, object_from_world = PlannerHarness(here), inverse(object_pose(here))
    shape = make_shape(dict(here.object.geometry))
    desk.rest(apply(object_from_world, motion.at(0.0)[0]), 120)
    sent = []
    for time_s in times:
        position, velocity = motion.at(float(time_s))
        sent.append(
            desk.see(apply(object_from_world, position), object_from_world[:3, :3] @ velocity)
        )
    desk.assert_bounded()
    below = shape.closest(
        apply(object_from_world, np.array([motion.at(float(time_s))[0] for time_s in times]))
    ).height_m
    touching = [one for one, height in zip(sent, below, strict=True) if height < -2e-4][10:]
    shown = [one.command for one in touching]
    held = {one.reason for one in shown if one.phase != "contact"}
    assert held <= ({"beyond_spin"} if gesture == "circle" and name in ROUND else set())
    first_held = next((i for i, one in enumerate(shown) if one.phase != "contact"), len(touching))
    off = [
        angle_between(one.motion.world_from_sheet[:3, 2], one.normal_world)
        for one in touching[:first_held]
    ]
    assert len(off) > 100
    assert np.degrees(np.quantile(off, 0.99)) < 0.5


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in BOTH else pytest.mark.long) for name in ROUND]
)
async def test_both_arms_carry_the_sheet_over_the_object(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Planner, bridges and the twin's arms: a slow stroke around the object, without a fault."""
    here = scene(name)
    monkeypatch.setattr(arm_loop, "paper_scene", lambda: here)
    _, arc_m = touchable(here)
    seconds = max(1.5, 0.7 * arc_m / here.working_range.speed_m_per_s)

    def path(at_s: float) -> Floats:
        share = min(max(at_s / seconds, 0.0), 1.0)
        arc = 0.35 * arc_m * share * share * (3.0 - 2.0 * share)
        point: Floats = map_to_surface(here, np.array([[0.0, arc, -0.001]]))[0]
        return point

    async with arm_loop.running_rig() as (rig, nodes):
        planner: Planner = nodes["planner"]
        await arm_loop.both_follow(rig, planner, path(0.0))
        await arm_loop.play_finger(rig, planner, path, seconds)

        def presented() -> bool:
            wanted, shown = rig.targets[-1][0], rig.samples[-1].world_from_sheet
            off_rad = angle_between(shown[:3, 2], wanted.normal_world)
            return wanted.phase == "contact" and off_rad < np.radians(0.5)

        # A machine that is busy makes the arms late.
        async with arm_loop.pointing(rig, planner, path(seconds)):
            await until(presented, "the sheet to be as it is wanted")
        target, shown = rig.targets[-1][0], rig.samples[-1].world_from_sheet
        assert all(not rig.newest(side).faults for side in ("left", "right"))
        lift = float((shown[:3, 3] - target.contact_world_m) @ target.normal_world)
        assert -0.002 < lift < 0.008
