"""Test the planner: approach, rolling, holding, bounds, compliance and determinism."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from flexsheet.messages.base import Header, Message
from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.notes import Note, NoteCode
from flexsheet.messages.scene import Scene
from flexsheet.messages.topics import Topic
from flexsheet.messages.types import FingertipReason, SheetTarget, SoftBody
from flexsheet.nodes.models.rigid import inverse, moved, transform, transform_from_rpy
from flexsheet.nodes.models.shapes import CylinderShape
from flexsheet.nodes.models.sheet.tension import (
    compute_sag_m,
    edge_force_n,
    push_stiffness_n_per_m,
)
from flexsheet.nodes.planner.compliance import (
    USABLE_FRACTION,
    choose_stretch,
    compute_stretch_range,
)
from flexsheet.nodes.planner.contact_state import ContactCommand, ContactLimits, ContactStateMachine
from flexsheet.nodes.planner.node import Planner
from flexsheet.nodes.planner.parameters import PlannerParameters
from flexsheet.nodes.planner.sheet_force import make_rubber
from tests.examples import examples
from tests.fingertips import fingertip
from tests.note_text import note_text
from tests.scenes import load_cylinder, load_values, make_weightless, set_density
from tests.twists import twist_between

Floats = NDArray[np.float64]
SCENE = make_weightless(load_cylinder())
HEAVY_SCENE = set_density(SCENE, 1200.0)
RADIUS = SCENE.object.geometry.radius_m
SHAPE = CylinderShape(RADIUS, SCENE.object.geometry.length_m)
FRAME_NS = 16_666_667


def on_cylinder(angle_deg: float, height: float = 0.0, x: float = 0.0) -> Floats:
    """Return a point at a height over the cylinder's skin, in the object's frame."""
    angle, reach = math.radians(angle_deg), RADIUS + height
    return np.array([x, reach * math.sin(angle), reach * math.cos(angle)])


def sheet_on_cylinder(angle: float, y_m: float) -> Floats:
    """Return object_from_sheet in closed form: tangent at the angle, with the sheet's line at
    `y_m`."""
    normal = np.array([0.0, math.sin(angle), math.cos(angle)])
    along = np.array([0.0, math.cos(angle), -math.sin(angle)])
    axes = np.column_stack([[1.0, 0.0, 0.0], along, normal])
    return transform(axes, RADIUS * normal - y_m * along)


def in_world(point: Floats) -> Floats:
    shift: Floats = np.array([0.0, 0.0, RADIUS])
    return point - shift


class Table:
    """Planner with messages from the test at 60 Hz."""

    def __init__(self, scene: Scene, **parameters: Any) -> None:
        self.sent: list[SheetTarget] = []
        self.planner = Planner(
            PlannerParameters(**parameters),
            name="planner",
            clock=VirtualClock(),
            send=self._take,
        )
        self.scene = scene
        self.now_ns = 0

    def _take(self, topic: Topic, message: Message, header: Header) -> None:
        assert isinstance(message, SheetTarget)
        assert header.source_ns == self.now_ns
        self.sent.append(message)

    async def start(self) -> None:
        await self.planner.setup()
        await self.planner.step("scene", self.scene, self.header())

    def header(self, age_ns: int = 5_000_000) -> Header:
        return Header(1, self.now_ns, self.now_ns + age_ns, "virtual", "test", 1)

    async def see(
        self,
        position: Floats,
        velocity: Floats | None = None,
        *,
        reason: FingertipReason = "ok",
        after_ns: int = FRAME_NS,
        age_ns: int = 5_000_000,
    ) -> SheetTarget:
        self.now_ns += after_ns
        message = fingertip(position, velocity, reason=reason)
        await self.planner.step("fingertip", message, self.header(age_ns))
        assert self.planner.errors == 0, self.planner.last_error
        return self.sent[-1]

    async def rest_at(self, position: Floats, frames: int = 240) -> SheetTarget:
        for _ in range(frames):
            target = await self.see(position)
        return target


async def table(**parameters: Any) -> Table:
    result = Table(SCENE, **parameters)
    await result.start()
    return result


async def test_nothing_is_sent_before_the_scene() -> None:
    desk = Table(SCENE)
    await desk.planner.setup()
    await desk.planner.step(
        "fingertip",
        fingertip(np.zeros(3)),
        desk.header(),
    )
    assert desk.sent == []


async def test_without_a_finger_the_sheet_waits_in_the_imaginary_screen() -> None:
    desk = await table()
    target = await desk.see(np.zeros(3), reason="no_marker")
    assert target.phase == "wait"
    assert target.reason == "fingertip_invalid"
    assert target.world_from_sheet == pytest.approx(np.eye(4), abs=1e-12)
    assert target.stretch_ratio == SCENE.sheet.min_stretch_ratio


@pytest.mark.parametrize("angle_deg", [-60.0, -20.0, 0.0, 45.0])
async def test_the_sheet_approaches_the_tangent_plane_under_the_finger(angle_deg: float) -> None:
    desk = await table()
    target = await desk.rest_at(in_world(on_cylinder(angle_deg, 0.03, 0.02)))
    assert target.phase == "approach"
    wanted = transform_from_rpy([0, 0, -RADIUS], [0, 0, 0]) @ sheet_on_cylinder(
        math.radians(angle_deg), 0.0
    )
    assert target.world_from_sheet == pytest.approx(wanted, abs=1e-9)
    assert target.contact_world_m == pytest.approx(
        in_world(on_cylinder(angle_deg, 0.0, 0.02)), abs=1e-9
    )
    assert target.contact_sheet_m == pytest.approx([0.02, 0.0], abs=1e-9)
    assert target.push_depth_m == 0.0


@pytest.mark.parametrize("angle_deg", [-50.0, 0.0, 50.0])
async def test_the_sheet_is_placed_behind_the_tangent_plane_by_its_sag(angle_deg: float) -> None:
    finger = in_world(on_cylinder(angle_deg, 0.03, 0.02))
    targets = []
    for scene in (HEAVY_SCENE, SCENE):
        desk = Table(scene)
        await desk.start()
        targets.append(await desk.rest_at(finger))
    heavy, weightless = targets
    normal = weightless.world_from_sheet[:3, 2]
    spec = HEAVY_SCENE.sheet
    distance_m = spec.width_m * weightless.stretch_ratio
    sag_m = compute_sag_m(
        make_rubber(spec),
        normal,
        density_kg_per_m3=spec.density_kg_per_m3,
        edge_distance_m=distance_m,
        across=0.5 + 0.02 / distance_m,
    )
    moved = heavy.world_from_sheet[:3, 3] - weightless.world_from_sheet[:3, 3]
    assert moved == pytest.approx(-sag_m * normal, abs=1e-9)
    assert np.sign(sag_m) == -np.sign(normal[1])
    assert heavy.normal_offset_m == weightless.normal_offset_m


async def stroke(
    desk: Table, from_deg: float, to_deg: float, frames: int, height: float = -0.002
) -> list[SheetTarget]:
    """Return a finger that moves uniformly from one angle to another, with its exact velocity."""
    rate = math.radians(to_deg - from_deg) / (frames * FRAME_NS * 1e-9)
    reach, sent = RADIUS + height, []
    for number in range(1, frames + 1):
        angle = from_deg + (to_deg - from_deg) * number / frames
        a = math.radians(angle)
        velocity = rate * reach * np.array([0.0, math.cos(a), -math.sin(a)])
        sent.append(await desk.see(in_world(on_cylinder(angle, height)), velocity))
    return sent


async def test_in_touch_the_sheet_rolls_without_slipping() -> None:
    desk = await table(prediction_horizon_s=0.0)
    await desk.rest_at(in_world(on_cylinder(0.0, 0.02)))
    first = await desk.rest_at(in_world(on_cylinder(0.0, -0.002)))
    assert first.phase == "contact"
    assert first.push_depth_m == pytest.approx(0.002, abs=1e-9)
    for frames, end_deg in ((300, 60.0), (600, -60.0), (300, 0.0)):
        begin_deg = {60.0: 0.0, -60.0: 60.0, 0.0: -60.0}[end_deg]
        sent = await stroke(desk, begin_deg, end_deg, frames)
        for number, target in enumerate(sent[30:], start=31):
            angle = math.radians(begin_deg + (end_deg - begin_deg) * number / frames)
            assert target.phase == "contact"
            # Arc AB = A'B; the sheet is tangent at B to the undeformed object.
            assert target.contact_sheet_m[1] == pytest.approx(RADIUS * angle, abs=1e-6)
            assert target.world_from_sheet[:3, 2] == pytest.approx(
                [0.0, math.sin(angle), math.cos(angle)], abs=1e-6
            )
    assert desk.sent[-1].world_from_sheet == pytest.approx(first.world_from_sheet, abs=1e-5)


async def test_the_published_twist_leads_to_the_next_pose() -> None:
    desk = await table(prediction_horizon_s=0.04)
    await desk.rest_at(in_world(on_cylinder(0.0, -0.001)))
    sent = await stroke(desk, 0.0, 50.0, 500)
    for before, after in itertools.pairwise(sent[50:]):
        duration_s = (after.valid_at_ns - before.valid_at_ns) * 1e-9
        ahead = moved(before.world_from_sheet, before.twist_world, duration_s)
        assert ahead == pytest.approx(after.world_from_sheet, abs=2e-5)


async def test_the_prediction_is_for_the_moment_that_it_names() -> None:
    desk = await table(prediction_horizon_s=0.05)
    await desk.rest_at(in_world(on_cylinder(0.0, -0.001)))
    sent = await stroke(desk, 0.0, 40.0, 600)
    assert sent[-1].valid_at_ns == desk.now_ns + 50_000_000
    ahead_deg = 40.0 + 40.0 / 10.0 * 0.05
    normal = sent[-1].world_from_sheet[:3, 2]
    assert math.degrees(math.atan2(normal[1], normal[2])) == pytest.approx(ahead_deg, abs=0.01)


async def test_the_lead_grows_with_the_fingertips_age_and_steps_stay_even() -> None:
    desk = await table(actuation_delay_s=0.03)
    for _ in range(200):
        target = await desk.see(in_world(on_cylinder(0.0, -0.001)), age_ns=12_000_000)
    assert (target.valid_at_ns - desk.now_ns) * 1e-9 == pytest.approx(0.042, abs=1e-4)
    leads_s = []
    for _ in range(200):
        target = await desk.see(in_world(on_cylinder(0.0, -0.001)), age_ns=45_000_000)
        leads_s.append((target.valid_at_ns - desk.now_ns) * 1e-9)
    assert leads_s[-1] == pytest.approx(0.075, abs=1e-4)
    assert np.diff(leads_s).min() >= 0.0
    assert np.diff(leads_s).max() < 0.5 * FRAME_NS * 1e-9


async def test_contact_has_hysteresis() -> None:
    desk = await table(prediction_horizon_s=0.0)
    phases = []
    for height_mm in (5.0, 1.0, 0.4, 1.0, 2.9, 3.1, 1.0, 0.6, 0.4):
        target = await desk.rest_at(in_world(on_cylinder(10.0, height_mm * 1e-3)), 2)
        phases.append(target.phase)
    assert phases == ["approach"] * 2 + ["contact"] * 3 + ["approach"] * 3 + ["contact"]


async def test_after_a_lift_the_sheet_is_met_at_its_middle_again() -> None:
    desk = await table(prediction_horizon_s=0.0)
    await desk.rest_at(in_world(on_cylinder(0.0, -0.001)))
    sent = await stroke(desk, 0.0, 50.0, 500)
    assert sent[-1].contact_sheet_m[1] > 0.03
    lifted = await desk.rest_at(in_world(on_cylinder(50.0, 0.02)))
    assert lifted.contact_sheet_m == pytest.approx([0.0, 0.0], abs=1e-9)


async def test_a_contact_during_the_approach_uses_the_sheet_as_it_is() -> None:
    desk = await table(prediction_horizon_s=0.0)
    await desk.rest_at(in_world(on_cylinder(40.0, 0.02)))
    for _ in range(3):
        before = await desk.see(in_world(on_cylinder(10.0, 0.02)))
    target = await desk.see(in_world(on_cylinder(10.0, 0.0)))
    shift = target.world_from_sheet[:3, 3] - before.world_from_sheet[:3, 3]
    assert target.phase == "contact"
    assert np.linalg.norm(shift) < 0.18 / 60 + 1e-9
    assert abs(target.contact_sheet_m[1]) > 0.001


LIMITS = ContactLimits(
    front=np.array([0.0, 0.0, 1.0]),
    max_tilt_rad=1.2,
    max_spin_rad=0.3,
    half_width_m=0.09,
    half_height_m=0.03,
    contact_on_m=0.0005,
    contact_off_m=0.003,
    max_depth_m=2.0 * RADIUS,
)
STILL = np.zeros(3)


class Desk:
    """Encounter with the cylinder, in coordinates of its cross-section."""

    def __init__(self) -> None:
        self.machine = ContactStateMachine(SHAPE, np.eye(3), LIMITS)

    def see(self, finger: Floats, velocity: Floats = STILL) -> ContactCommand:
        now = self.machine.contact.object_from_sheet
        return self.machine.step(finger, velocity, now)


def angle_of(shown: ContactCommand) -> float:
    return math.atan2(shown.contact.normal[1], shown.contact.normal[2])


def touched(angle_deg: float = 0.0) -> Desk:
    desk = Desk()
    assert desk.see(on_cylinder(angle_deg, -0.001)).phase == "contact"
    return desk


@pytest.mark.parametrize(
    ("finger", "reason", "depth"),
    [
        (np.array([0.0, 0.0, -1.1 * RADIUS]), "through_object", 2.1 * RADIUS),
        (on_cylinder(0.0, -0.001, 0.061), "past_object_edge", 0.001),
        (on_cylinder(0.0, -0.001, -0.08), "past_object_edge", 0.001),
    ],
)
def test_the_sheet_holds_where_it_cannot_follow(finger: Floats, reason: str, depth: float) -> None:
    desk = touched()
    shown = desk.see(finger, np.array([0.1, 0.2, 0.3]))
    assert shown.phase == "hold"
    assert shown.reason == reason
    assert (shown.twist == 0.0).all()
    assert shown.push_depth_m == pytest.approx(depth, abs=1e-12)
    assert (
        np.abs(shown.contact.position_sheet_m) <= [LIMITS.half_width_m, LIMITS.half_height_m]
    ).all()
    back = desk.see(on_cylinder(0.0, -0.001))
    assert (back.phase, angle_of(back)) == ("contact", pytest.approx(0.0, abs=1e-12))


def test_the_sheet_holds_at_its_usable_height_and_continues_when_the_finger_is_back() -> None:
    desk = touched()
    for angle_deg in np.arange(0.0, 61.0, 2.0):
        shown = desk.see(on_cylinder(angle_deg, -0.001))
        assert abs(shown.contact.position_sheet_m[1]) <= LIMITS.half_height_m + 1e-12
    assert shown.phase == "hold"
    assert (shown.twist == 0.0).all()
    assert shown.reason == "past_sheet_height"
    assert angle_of(shown) == pytest.approx(LIMITS.half_height_m / RADIUS, abs=1e-3)
    for angle_deg in np.arange(60.0, -1.0, -2.0):
        shown = desk.see(on_cylinder(angle_deg, -0.001))
    assert (shown.phase, angle_of(shown)) == ("contact", pytest.approx(0.0, abs=1e-9))


def test_a_deep_push_neither_shakes_nor_leaves_the_sheet() -> None:
    """The finger moves to the axis and beyond, with a tremor of a tenth of a millimetre."""
    desk = touched()
    noise = np.random.default_rng(1)
    for depth in np.concatenate([np.linspace(0.001, 0.05, 200), np.full(200, 0.05)]):
        finger = np.array([0.0, 0.0, RADIUS - depth]) + noise.normal(0.0, 1e-4, 3)
        shown = desk.see(finger)
        assert shown.phase == "contact"
        assert abs(angle_of(shown)) < math.radians(1.2)
        assert shown.push_depth_m == pytest.approx(depth, abs=6e-4)


@pytest.mark.parametrize("depth", [0.002, 0.012, 0.03])
def test_stroking_while_pushing_rolls_by_what_the_finger_moves_and_never_steps(
    depth: float,
) -> None:
    desk = touched()
    for depth_now in np.linspace(0.001, depth, 50):
        desk.see(np.array([0.0, 0.0, RADIUS - depth_now]))
    angles = [
        angle_of(desk.see(np.array([0.0, y, RADIUS - depth]), np.array([0.0, 0.1, 0.0])))
        for y in np.arange(0.0, 0.008, 0.0005)
    ]
    steps = np.diff(angles)
    assert (steps > 0.0).all()
    # Between rolling along the sheet (dy / R) and about the axis (dy / (R - depth)).
    assert steps.max() <= 0.0005 / (RADIUS - min(depth, 0.018)) * 1.3
    assert steps.min() >= 0.0005 / RADIUS * 0.7


def test_a_finger_on_the_axis_from_the_first_is_held_and_not_met() -> None:
    shown = Desk().see(np.zeros(3))
    assert (shown.phase, angle_of(shown)) == ("hold", 0.0)
    assert (shown.twist == 0.0).all()


def test_behind_the_object_the_side_is_kept() -> None:
    desk = Desk()
    angles = [
        angle_of(desk.see(on_cylinder(angle_deg, 0.02)))
        for angle_deg in (40.0, 100.0, 170.0, 185.0, 200.0, 175.0)
    ]
    assert angles == pytest.approx([math.radians(40.0)] + [LIMITS.max_tilt_rad] * 5, abs=0.005)
    assert max(angles) <= LIMITS.max_tilt_rad


@examples(100)
@given(
    st.lists(
        st.tuples(st.floats(-0.08, 0.08), st.floats(-0.06, 0.06), st.floats(-0.06, 0.06)),
        min_size=1,
        max_size=20,
    )
)
def test_wherever_the_finger_goes_the_presentation_is_within_reach(
    path: list[tuple[float, float, float]],
) -> None:
    desk = Desk()
    for x, y, z in path:
        shown = desk.see(np.array([x, y, z]), np.array([0.1, -0.1, 0.1]))
        assert abs(angle_of(shown)) <= LIMITS.max_tilt_rad + 1e-9
        most = np.array([LIMITS.half_width_m, LIMITS.half_height_m])
        assert (np.abs(shown.contact.position_sheet_m) <= most + 1e-9).all()
        assert np.isfinite(shown.twist).all()
        assert shown.push_depth_m >= 0.0


async def test_a_lost_finger_brings_the_sheet_to_rest_smoothly() -> None:
    desk = await table(prediction_horizon_s=0.0)
    await desk.rest_at(in_world(on_cylinder(0.0, -0.001)))
    await stroke(desk, 0.0, 40.0, 120)
    lost = [await desk.see(np.zeros(3), reason="two_markers") for _ in range(30)]
    assert {target.phase for target in lost} == {"hold"}
    assert lost[0].reason == "fingertip_invalid"
    assert lost[-1].twist_world == pytest.approx(np.zeros(6), abs=0.0)
    assert lost[-1].world_from_sheet == pytest.approx(lost[-2].world_from_sheet, abs=1e-15)
    found = await desk.rest_at(in_world(on_cylinder(40.0, -0.001)), 60)
    assert found.phase == "contact"
    assert found.contact_sheet_m[1] == pytest.approx(RADIUS * math.radians(40.0), abs=1e-5)


async def test_an_old_fingertip_is_held_and_one_out_of_order_left_out() -> None:
    desk = await table()
    await desk.rest_at(in_world(on_cylinder(0.0, 0.02)), 5)
    target = await desk.see(in_world(on_cylinder(30.0, 0.02)), age_ns=150_000_000)
    assert target.phase == "hold"
    assert target.reason == "fingertip_too_old"
    count = len(desk.sent)
    await desk.see(in_world(on_cylinder(30.0, 0.02)), after_ns=-FRAME_NS)
    assert len(desk.sent) == count
    assert Note(code=NoteCode.FINGERTIPS_LATE, detail="1") in desk.planner.notes


@examples(10)
@given(st.integers(0, 2**32 - 1))
async def test_motion_is_bounded_for_any_finger(seed: int) -> None:
    random = np.random.default_rng(seed)
    desk = await table(prediction_horizon_s=0.05)  # so that targets are even in time
    given = desk.planner.parameters
    sent = []
    for _ in range(40):
        spot = random.uniform([-0.1, -0.1, -0.1], [0.1, 0.1, 0.1])
        reason: FingertipReason = "no_marker" if random.random() < 0.2 else "ok"
        velocity = random.uniform(-1.0, 1.0, 3)
        for _ in range(random.integers(1, 8)):
            sent.append(await desk.see(spot, velocity, reason=reason))
    step_s = FRAME_NS * 1e-9
    poses = [target.world_from_sheet for target in sent]
    steps = np.array([twist_between(a, b, step_s) for a, b in itertools.pairwise(poses)])
    speed, turn = np.linalg.norm(steps[:, :3], axis=1), np.linalg.norm(steps[:, 3:], axis=1)
    assert speed.max() <= given.speed_m_per_s * (1 + 1e-6)
    assert turn.max() <= given.turn_rad_per_s * (1 + 1e-6)
    changes = np.linalg.norm(np.diff(steps[:, :3], axis=0), axis=1) / step_s
    assert changes.max() <= given.acceleration_m_per_s2 * (1 + 1e-6)
    jerks = np.linalg.norm(np.diff(steps[:, :3], n=2, axis=0), axis=1) / step_s**2
    assert jerks.max() <= given.jerk_m_per_s3 * (1 + 1e-6)
    rates = np.diff([target.stretch_ratio for target in sent]) / step_s
    assert np.abs(rates).max() <= given.stretch_rate_per_s * (1 + 1e-6)


def soft(stiffness: float) -> SoftBody:
    """Return an object of that stiffness, a linear spring."""
    return SoftBody(
        mesh_id="m",
        method="test",
        in_range=True,
        push_depth_m=0.001,
        force_world_n=np.zeros(3),
        stiffness_n_per_m=stiffness,
        force_curve=np.array([[0.0, 0.0], [0.05, 0.05 * stiffness]]),
        displacement_world_m=np.zeros((4, 3), dtype=np.float32),
    )


async def test_the_stretch_goes_to_the_objects_stiffness_at_a_bounded_rate() -> None:
    desk = await table(compliance_mode="stiffness")
    position = in_world(on_cylinder(0.0, -0.001))
    await desk.rest_at(position, 10)
    await desk.planner.step("soft_body", soft(45.0), desk.header())
    target = await desk.rest_at(position, 300)
    sheet = SCENE.sheet
    force = edge_force_n(target.stretch_ratio, sheet)
    assert push_stiffness_n_per_m(force, width_m=sheet.width_m) == pytest.approx(45.0, rel=1e-6)
    assert note_text(desk.planner) == "sheet force model: table"


@pytest.mark.parametrize(("stiffness", "words"), [(2.0, "softer"), (5000.0, "stiffer")])
async def test_what_the_sheet_cannot_render_is_reported(stiffness: float, words: str) -> None:
    desk = await table(compliance_mode="stiffness")
    await desk.planner.step("soft_body", soft(stiffness), desk.header())
    assert words in note_text(desk.planner)
    least, largest = compute_stretch_range(SCENE.sheet)
    target = await desk.rest_at(in_world(on_cylinder(0.0, -0.001)), 300)
    assert target.stretch_ratio == pytest.approx(least if words == "softer" else largest)


def test_the_arms_force_limits_the_stretch() -> None:
    weak = SCENE.sheet.model_copy(update={"max_edge_force_n": 8.0})
    _, largest = compute_stretch_range(weak)
    force = edge_force_n(choose_stretch(1e4, weak)[0], weak)
    assert largest < weak.max_stretch_ratio
    assert force == pytest.approx(USABLE_FRACTION * 8.0, rel=1e-9)


async def test_the_same_inputs_give_the_same_bytes() -> None:
    async def once() -> list[bytes]:
        random = np.random.default_rng(3)
        desk = await table()
        for _ in range(100):
            position = in_world(on_cylinder(random.uniform(-60, 60), random.uniform(-0.01, 0.01)))
            await desk.see(position, random.uniform(-0.1, 0.1, 3))
            await desk.planner.step("soft_body", soft(random.uniform(1, 200)), desk.header())
        return [target.model_dump_json().encode() for target in desk.sent]

    assert await once() == await once()


async def test_an_object_turned_in_the_world_is_met_from_the_users_side() -> None:
    data = load_values()
    data["object"]["world_from_object"] = {
        "position_m": [0.01, 0.02, -0.05],
        "rpy_rad": [math.radians(130.0), 0.0, 0.0],
    }
    desk = Table(Scene.model_validate(data))
    await desk.start()
    world_from_object = transform_from_rpy([0.01, 0.02, -0.05], [math.radians(130.0), 0.0, 0.0])
    finger = np.array([0.0, 0.02, 0.02])
    target = await desk.rest_at(finger)
    assert target.normal_world == pytest.approx([0.0, 0.0, 1.0], abs=1e-9)
    on_object = (inverse(world_from_object) @ np.append(target.contact_world_m, 1.0))[:3]
    assert np.hypot(on_object[1], on_object[2]) == pytest.approx(RADIUS)


async def test_an_object_that_cannot_be_presented_is_reported_and_nothing_is_sent() -> None:
    desk = await table()
    await desk.rest_at(in_world(on_cylinder(0.0, 0.02)), 3)
    sent = len(desk.sent)
    data = load_values()
    data["object"]["geometry"] = {"shape": "plane", "width_m": 0.1, "height_m": 0.1}
    data["object"]["world_from_object"] = {
        "position_m": [0.0, 0.0, 0.0],
        "rpy_rad": [math.pi, 0.0, 0.0],
    }
    data["object"]["support"] = {"kind": "base", "height_m": 0.008}
    await desk.planner.step("scene", Scene.model_validate(data), desk.header())
    assert desk.planner.errors == 1
    assert "object.world_from_object" in desk.planner.last_error
    desk.now_ns += FRAME_NS
    await desk.planner.step("fingertip", fingertip(np.array([0.0, 0.0, 0.02])), desk.header())
    assert len(desk.sent) == sent
