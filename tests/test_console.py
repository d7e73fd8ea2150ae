"""The console's parts: what is drawn, meant, chosen, guarded, told and replayed."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from ruamel.yaml import YAML
from websockets.datastructures import Headers
from websockets.http11 import Request

from launch.plans.documents import BadInputError
from launch.plans.plan import load_plan
from messages.bag import BagError, BagReader, BagWriter
from messages.base import Header, Message
from messages.clock import VirtualClock
from messages.methods import Methods
from messages.scene import Scene
from messages.topics import TOPICS, Topic
from messages.types import (
    ArmState,
    Correction,
    Display,
    EStop,
    FingerPath,
    Fingertip,
    Moment,
    PortStatus,
    Recording,
    Status,
    TwinEye,
)
from messages.wire import WireError, encode
from nodes.arm_bridge import kinematics
from nodes.console import panels, scenes
from nodes.console.aim import HOVER_M, Aim
from nodes.console.arms import PIECES, link_poses, rounded_box
from nodes.console.desk import SETTLE_S, Desk, Files, Look, SceneDesk
from nodes.console.finger import Finger
from nodes.console.guard import COOKIE, ConsoleError, Guard, read_token
from nodes.console.history import SERIES, WINDOW_S, History
from nodes.console.newest import Newest
from nodes.console.node import ConsoleParameters
from nodes.console.picture import picture_of, ray_vertices, rays
from nodes.console.replay import Timeline, bags_in
from nodes.console.sheet import COLUMNS, ROWS, film, hit_by_ray, sheet_points
from nodes.console.view import finger_mesh, line_segments
from nodes.models.rigid import rotation_from_vector, transform
from nodes.recorder.node import Recorder, RecorderParameters
from tests.arm_states import arm_state
from tests.colours import luminance
from tests.fingertips import fingertip
from tests.plans import scene_with

Floats = NDArray[np.float64]
ROOT = Path(__file__).resolve().parent.parent
TOKEN = "0123456789abcdef0123"
WIDTH_M = HEIGHT_M = 0.24


@pytest.fixture(scope="module")
def scene() -> Scene:
    text = (ROOT / "launch" / "scenes" / "cylinder.yaml").read_text()
    return Scene.model_validate(YAML(typ="safe").load(text))


def edges(width_m: float = WIDTH_M) -> tuple[Floats, Floats]:
    half = 0.5 * width_m
    return transform(np.eye(3), (-half, 0, 0)), transform(np.eye(3), (half, 0, 0))


def sheet(fingertip: Floats | None = None) -> Floats:
    points = sheet_points(*edges(), height_m=HEIGHT_M, fingertip=fingertip, finger_radius_m=0.007)
    assert points is not None
    return points


class Shelf:
    """A source that holds what the test puts on it."""

    def __init__(self, **messages: Message) -> None:
        self.held = {
            name.replace("__", "/"): (message, Header(1, 10_000_000, 13_000_000, "c", "w", 1))
            for name, message in messages.items()
        }

    def newest(self, name: str, kind: Any) -> Any:
        return self.held.get(name)


# What is drawn.


@given(st.lists(st.floats(-2.0, 2.0), min_size=6, max_size=6))
def test_the_drawn_flange_is_where_the_kinematics_have_it(joints: list[float]) -> None:
    base = transform(rotation_from_vector(np.array([0.3, -0.2, 0.5])), (0.1, -0.4, 0.2))
    poses = link_poses(base, np.array(joints))
    assert poses.shape == (7, 4, 4)
    np.testing.assert_allclose(poses[-1], base @ kinematics.forward(joints), atol=1e-12)


@pytest.mark.parametrize("piece", PIECES)
def test_boxes_are_closed_and_wound_outwards(piece: Any) -> None:
    vertices, triangles = rounded_box(piece.size_m, (0.0, 0.0, 0.0))
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    volume = float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6.0
    assert 0.8 * np.prod(piece.size_m) < volume < np.prod(piece.size_m)
    tip, faces = finger_mesh(0.007)
    a, b, c = (tip[faces[:, i]] for i in range(3))
    assert float(np.einsum("ij,ij->", a, np.cross(b, c))) > 0.0


@given(st.floats(-0.115, 0.115), st.floats(-0.12, 0.12))
def test_the_film_is_held_at_its_edges_and_as_deep_as_the_finger(x: float, y: float) -> None:
    ends, up = np.array([-0.12, 0.12]), np.linspace(-0.12, 0.12, 9)
    places = [film(np.full(9, end), up, (x, y), (WIDTH_M, HEIGHT_M), 0.007) for end in ends]
    np.testing.assert_allclose(places, 0.0, atol=1e-9)
    at_finger = film(np.array([x]), np.array([y]), (x, y), (WIDTH_M, HEIGHT_M), 0.007)
    assert at_finger[0] == 1.0
    anywhere = film(np.linspace(-0.12, 0.12, 9), up, (x, y), (WIDTH_M, HEIGHT_M), 0.007)
    assert ((anywhere >= -1e-12) & (anywhere <= 1.0)).all()


def test_the_film_is_free_at_top_and_bottom() -> None:
    near = np.array([0.12 - 1e-5, 0.12])
    one, other = film(np.full(2, 0.02), near, (0.0, 0.08), (WIDTH_M, HEIGHT_M), 0.007)
    assert abs(one - other) < 1e-7


def test_a_sheet_that_is_not_there_or_not_pushed() -> None:
    assert sheet_points(*edges(0.01), height_m=1.0, fingertip=None, finger_radius_m=1.0) is None
    nan = np.full((4, 4), np.nan)
    assert sheet_points(nan, nan, height_m=1.0, fingertip=None, finger_radius_m=1.0) is None
    assert np.ptp(sheet()[:, 2]) == 0.0
    assert np.ptp(sheet(np.array([0.0, 0.0, 0.01]))[:, 2]) == 0.0, "a finger before the sheet"
    dented = sheet(np.array([0.02, 0.01, -0.03]))
    assert dented[:, 2].min() == pytest.approx(-0.03, abs=1e-3)
    assert line_segments(dented).shape == (2 * 9 * (ROWS - 1), 2, 3)


@given(st.floats(-0.11, 0.11), st.floats(-0.11, 0.11))
def test_rays_meet_the_flat_sheet_where_the_plane_is(x: float, y: float) -> None:
    eye = np.array([0.03, 0.05, 0.4])
    towards = np.array([[x, y, 0.0]]) + 0.3 * (np.array([[x, y, 0.0]]) - eye)
    np.testing.assert_allclose(hit_by_ray(sheet(), eye, towards), [[x, y, 0.0]], atol=1e-9)


def test_rays_that_miss_have_no_segments(scene: Scene) -> None:
    eye = scene.eyes.centre_world_m
    points = np.array([[0.0, 0.0, -0.1], [5.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    hits = hit_by_ray(sheet(), eye, points)
    assert np.isfinite(hits).all(axis=1).tolist() == [True, False, False]
    to_eye, from_projector = rays(scene, sheet(), points)
    assert to_eye.shape == from_projector.shape == (1, 2, 3)
    np.testing.assert_allclose(to_eye[0, 1], from_projector[0, 0])


def test_a_picture_of_what_is_known(scene: Scene) -> None:
    nothing = picture_of(scene, Shelf())
    assert (nothing.links, nothing.sheet, nothing.finger) == ({}, None, None)
    left, right = edges()
    both = picture_of(
        scene,
        Shelf(
            arm_left=arm_state("left", world_from_flange=left),
            arm_right=arm_state("right", world_from_flange=right),
            fingertip=fingertip(np.array([0.0, 0.0, -0.01])),
        ),
    )
    assert both.links["left"].shape == (7, 4, 4)
    assert both.sheet is not None
    assert both.sheet.shape == (ROWS * COLUMNS, 3)
    assert both.finger_valid
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5)] * 3), axis=-1).reshape(-1, 3)
    assert len(set(ray_vertices(grid).tolist())) == 9


# What the mouse means.


def test_the_mouse_means_a_point_below_the_surface_or_beside_it(scene: Scene) -> None:
    aim = Aim(scene)
    eye, forward = np.array([0.0, 0.0, 0.6]), np.array([0.0, 0.0, -2.0])
    np.testing.assert_allclose(aim.under_ray(eye, forward, 0.0), [0.0, 0.0, 0.0], atol=2e-4)
    np.testing.assert_allclose(aim.under_ray(eye, forward, 0.01), [0.0, 0.0, -0.01], atol=2e-4)
    np.testing.assert_allclose(aim.place(0.03, 0.0, 0.01), [0.03, 0.0, -0.01], atol=2e-4)
    beside = aim.under_ray(eye, np.array([0.0, 0.3, -0.6]), 0.01)
    assert beside[1] > 0.05
    assert (beside >= scene.finger.volume_min_m).all()
    assert (beside <= scene.finger.volume_max_m).all()
    np.testing.assert_allclose(aim.lifted(np.array([0.0, 0.0, -0.01])), [0, 0, HOVER_M], atol=1e-6)
    for bad in (np.zeros(3), np.array([np.nan, 0, 1])):
        with pytest.raises(ValueError, match="direction"):
            aim.under_ray(eye, bad, 0.0)


def test_the_finger_goes_round_the_object_and_not_through_it(scene: Scene) -> None:
    aim, sent = Aim(scene), []
    finger = Finger(sent.append, speed_m_per_s=0.1)
    finger.use(aim)
    finger.push(0.003)
    finger.place(0.0, -0.04)
    for _ in range(60):
        finger.advance(0.05, None)
    begun = len(sent)
    finger.place(0.0, 0.04)
    for _ in range(60):
        finger.advance(0.05, None)
    ways = np.array([path.positions_world_m[0] for path in sent[begun:]])
    radius = scene.object.geometry.radius_m  # type: ignore[union-attr]  # it is a cylinder
    centre = scene.object.world_from_object.position_m
    depths = radius - np.linalg.norm(ways[:, 1:] - centre[1:], axis=1)
    assert depths.max() < 0.003 + 2e-4
    assert ways[-1, 1] == pytest.approx(0.04, abs=2e-3)
    assert np.linalg.norm(np.diff(ways, axis=0), axis=1).max() < 0.008
    rested = len(sent)
    finger.advance(0.05, None)
    assert len(sent) == rested, "a finger that is there is told nothing"
    assert all(isinstance(path, FingerPath) for path in sent)


def test_a_finger_that_cannot_be_moved_says_why(scene: Scene) -> None:
    finger = Finger(lambda message: None, speed_m_per_s=0.1)
    with pytest.raises(ValueError, match="still being read"):
        finger.place(0.0, 0.0)
    finger.use(Aim(scene))
    for depth in (-0.001, np.nan, np.inf):
        with pytest.raises(ValueError, match="no depth"):
            finger.push(depth)


# Scenes.

SOLIDS: list[dict[str, Any]] = [
    {"shape": "cylinder", "radius_m": 0.05, "length_m": 0.2},
    {"shape": "sphere", "radius_m": 0.05},
    {"shape": "ellipsoid", "semi_axes_m": [0.05, 0.04, 0.03]},
    {"shape": "rounded_box", "size_m": [0.1, 0.08, 0.06], "edge_radius_m": 0.01},
    {"shape": "plane", "width_m": 0.2, "height_m": 0.2},
]


@pytest.mark.parametrize("geometry", SOLIDS, ids=lambda one: str(one["shape"]))
def test_a_larger_object_keeps_its_front(geometry: dict[str, Any]) -> None:
    first = scene_with(geometry, (0.0, 0.0, -0.05), (0.2, 0.0, 0.0))
    grown = scenes.edited(first, young_modulus_pa=9e3, stretch_ratio=1.05, size_ratio=1.3)
    assert grown.object.material.young_modulus_pa == 9e3
    assert grown.sheet.min_stretch_ratio == 1.05

    def front(scene: Scene) -> float:
        shape = Aim(scene)
        seen = shape.under_ray(np.array([0.0, 0.0, 0.5]), np.array([0.0, 0.0, -1.0]), 0.0)
        return float(seen[2])

    if geometry["shape"] in ("sphere", "plane"):
        assert front(grown) == pytest.approx(front(first), abs=3e-4)
    assert grown.object.world_from_object.position_m[2] <= -0.05


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("young_modulus_pa", -1.0),
        ("young_modulus_pa", np.nan),
        ("stretch_ratio", 0.9),
        ("size_ratio", 0.0),
        ("size_ratio", np.inf),
    ],
)
def test_values_that_make_no_scene_are_refused(scene: Scene, name: str, value: float) -> None:
    good = {"young_modulus_pa": 4e3, "stretch_ratio": 1.02, "size_ratio": 1.0}
    with pytest.raises(scenes.SceneChoiceError):
        scenes.edited(scene, **good | {name: value})


async def test_scenes_are_sent_once_a_slider_rests(scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "other.json").write_text(scene.model_dump_json())
    sent: list[Message] = []
    desk = SceneDesk(sent.append, tmp_path, scene)
    desk.slide(10.0, young_modulus_pa=5e3)
    desk.slide(10.3, young_modulus_pa=6e3)
    assert not desk.settle(10.3 + 0.9 * SETTLE_S)
    assert desk.settle(10.3 + SETTLE_S)
    assert not desk.settle(20.0)
    assert [one.object.material.young_modulus_pa for one in sent if isinstance(one, Scene)] == [6e3]
    desk.choose("other")
    assert desk.sliders.young_modulus_pa == scene.object.material.young_modulus_pa
    with pytest.raises(scenes.SceneChoiceError, match='no scene "none"; there are: other'):
        desk.choose("none")
    desk.slide(30.0, size_ratio=-1.0)
    with pytest.raises(scenes.SceneChoiceError):
        desk.settle(31.0)
    assert len(sent) == 2


def test_a_console_that_is_started_again_goes_on_where_it_was(scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "plan.json").write_text(f'{{"scene": {scene.model_dump_json()}}}')
    other = scene.model_copy(update={"name": "other"})
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "other.json").write_text(other.model_dump_json())
    files = Files(tmp_path / "plan.json", tmp_path / "scenes", tmp_path, tmp_path / "console.json")
    warnings: list[str] = []

    def desk() -> tuple[Desk, list[Message]]:
        sent: list[Message] = []
        made = Desk(sent.append, files, Finger(sent.append, speed_m_per_s=0.1), warnings.append)
        made.begin()
        return made, sent

    first, sent = desk()
    assert [one.name for one in sent if isinstance(one, Scene)] == [scene.name]
    first.scenes.choose("other")
    first.scenes.slide(1.0, young_modulus_pa=9e3)
    first.scenes.settle(2.0)
    first.record(True)
    again, sent = desk()
    assert again.scenes.sliders == first.scenes.sliders
    taken_up, recording = sent
    assert isinstance(taken_up, Scene)
    assert (taken_up.name, taken_up.object.material.young_modulus_pa) == ("other", 9e3)
    assert recording == Recording(running=True)
    again.record(False)
    again.scenes.choose("other")
    third, sent = desk()
    assert [type(message) for message in sent] == [Scene], "nothing is being recorded"
    assert third.scenes.sliders.young_modulus_pa == scene.object.material.young_modulus_pa
    assert warnings == []
    files.kept.write_text("{")
    (begun,) = desk()[1]
    assert isinstance(begun, Scene)
    assert begun.name == scene.name
    assert "cannot be taken up again" in warnings[0]


def test_looking_puts_back_what_another_had_set(scene: Scene) -> None:
    sent: list[Display] = []

    def publish(message: Message) -> None:
        assert isinstance(message, Display)
        sent.append(message)

    look = Look(publish, scene)
    look.advance(1.0)
    assert not sent, "nobody wants to look"
    anothers = Display(correction="one_plane", stereo="anaglyph", label="mine")
    look.heed(anothers)
    look.wanted = True
    look.advance(2.0)
    asked = sent[0]
    assert (asked.stereo, asked.pixels_every > 0) == ("mono", True)
    look.heed(asked)
    pixel = np.zeros((2, 2, 3), np.uint8)
    eye = TwinEye(label="x", correction="none", metres_per_px=1e-3, seen=pixel, proper=pixel)
    assert not look.got(eye, 2.5)
    assert look.got(eye.model_copy(update={"label": asked.label}), 3.0)
    assert sent[-1] is anothers
    look.advance(3.1)
    assert len(sent) == 2, "not at once again"
    look.again()
    look.advance(3.2)
    look.advance(60.0)
    assert sent[-1] is anothers, "a picture that never comes is given up"
    look.follow(scene)
    assert len(sent) == 4, "a scene changes nothing of what another has set"


def test_after_a_look_each_scene_has_its_own_correction_until_one_is_picked(
    scene: Scene, tmp_path: Path
) -> None:
    def corrected_by(correction: Correction | None) -> Scene:
        return scene.model_copy(update={"methods": Methods(correction=correction)})

    (tmp_path / "plan.json").write_text(
        f'{{"scene": {corrected_by("four_triangles").model_dump_json()}}}'
    )
    for name, correction in (("flat", "one_plane"), ("silent", None)):
        (tmp_path / f"{name}.json").write_text(corrected_by(correction).model_dump_json())
    sent: list[Message] = []
    files = Files(tmp_path / "plan.json", tmp_path, tmp_path, tmp_path / "console.json")
    desk = Desk(sent.append, files, Finger(sent.append, speed_m_per_s=0.1), print)

    def corrections() -> list[str]:
        return [message.correction for message in sent if isinstance(message, Display)]

    desk.begin()
    desk.scenes.choose("flat")
    assert corrections() == [], "the renderer follows the scene by itself"
    desk.scenes.choose("silent")
    desk.look.follow(corrected_by("four_triangles"))
    desk.look.wanted = True
    desk.look.advance(1.0)
    desk.look.advance(60.0)
    rested = sent[-1]
    assert isinstance(rested, Display)
    desk.look.heed(rested)  # a console hears what it says
    assert corrections() == ["four_triangles", "four_triangles"]
    desk.scenes.choose("flat")
    desk.scenes.choose("silent")
    assert corrections()[2:] == ["one_plane", "two_pass"]
    desk.look.picked = "none"
    desk.scenes.choose("flat")
    assert corrections()[4:] == ["none"]


# The guard.


def asked(path: str = "/", host: str = "127.0.0.1:8080", **headers: str) -> Request:
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    return Request(path, Headers({"Host": host, **named}))


def status_of(guard: Guard, request: Request) -> int:
    refused = guard.refusal(request)
    return 200 if refused is None else refused.status_code


def test_on_loopback_only_the_computers_own_pages_may_ask() -> None:
    guard = Guard("127.0.0.1", None)
    assert status_of(guard, asked()) == 200
    assert status_of(guard, asked(host="localhost:8080")) == 200
    assert status_of(guard, asked(host="[::1]:8080")) == 200
    assert status_of(guard, asked(Origin="http://127.0.0.1:8080", Upgrade="websocket")) == 200
    assert status_of(guard, asked(Origin="http://evil.example", Upgrade="websocket")) == 403
    assert status_of(guard, asked(Origin="null")) == 403
    assert status_of(guard, asked(host="evil.example:8080")) == 403, "a name bound to loopback"
    assert status_of(guard, asked(host="")) == 403
    assert status_of(guard, asked(host="[::1")) == 403


def test_with_a_token_who_does_not_know_it_is_sent_away() -> None:
    guard = Guard("192.0.2.1", TOKEN)
    host = "192.0.2.1:8080"
    assert status_of(guard, asked(host=host)) == 401
    assert status_of(guard, asked(f"/?token={TOKEN}x", host)) == 401
    assert status_of(guard, asked("/?token=", host)) == 401
    assert status_of(guard, asked("/?token=ü", host)) == 401
    welcome = guard.refusal(asked(f"/?token={TOKEN}", host))
    assert welcome is not None
    assert (welcome.status_code, welcome.headers["Location"]) == (303, "/")
    cookie = welcome.headers["Set-Cookie"].partition(";")[0]
    assert cookie == f"{COOKIE}={TOKEN}"
    assert status_of(guard, asked(host=host, Cookie=cookie)) == 200
    assert status_of(guard, asked(host=host, Cookie=f"{COOKIE}=guess")) == 401
    assert status_of(guard, asked(host=host, Cookie='a=b=;;"==')) == 401
    wrong = asked(host=host, Cookie=cookie, Origin="http://evil.example")
    assert status_of(guard, wrong) == 403


def test_beyond_loopback_there_is_no_page_without_a_token(tmp_path: Path) -> None:
    with pytest.raises(ConsoleError, match="beyond loopback"):
        Guard("192.0.2.1", None)
    with pytest.raises(ValueError, match="token_file"):
        ConsoleParameters(address="192.0.2.1")
    with pytest.raises(ValueError, match="no IP address"):
        ConsoleParameters(address="everywhere")
    assert ConsoleParameters(address="0.0.0.0", token_file=tmp_path / "t").address == "0.0.0.0"
    file = tmp_path / "token"
    with pytest.raises(ConsoleError, match="cannot be read"):
        read_token(file)
    file.write_text(TOKEN + "\n")
    file.chmod(0o644)
    with pytest.raises(ConsoleError, match="chmod 600"):
        read_token(file)
    file.chmod(0o600)
    assert read_token(file) == TOKEN
    for short in ("abc", "a b" * 10, "ä" * 20):
        file.write_text(short)
        with pytest.raises(ConsoleError, match="token_hex"):
            read_token(file)


# What is told.


def port(topic: str, **changes: Any) -> PortStatus:
    values: dict[str, Any] = {
        "topic": topic,
        "rate_hz": 60.0,
        "age_s": 0.012,
        "messages": 10,
        "dropped": 0,
        "gaps": 0,
        "rejected": 0,
    }
    return PortStatus(**values | changes)


def status(node: str, **changes: Any) -> Status:
    values: dict[str, Any] = {
        "node": node,
        "state": "running",
        "pid": 1,
        "uptime_s": 1.0,
        "cpu_ratio": 0.25,
        "resident_bytes": 1,
        "inputs": (),
        "outputs": (),
        "errors": 0,
        "last_error": "",
        "note": "",
        "plan_hash": "",
        "clock_id": "here",
    }
    return Status(**values | changes)


def test_tables_say_in_words_what_is_wrong() -> None:
    statuses = {
        "camera": (status("camera", outputs=(port("stereo", rate_hz=3.0), port("eye"))), 0.5),
        "planner": (status("planner", inputs=(port("stereo", dropped=7, gaps=2, rejected=1),)), 0),
        "left": (status("left", state="degraded", errors=2, last_error="<b>bang</b>"), 0.0),
        "right": (status("right", outputs=(port("frame", rate_hz=0.0),)), 9.0),
    }
    topics, nodes = panels.topics_table(statuses), panels.nodes_table(statuses)
    assert "1 refused" in topics
    assert ">12<" in topics, "the age, ms"
    assert ">7<" in topics
    assert "frame" not in topics, "what a silent node once wrote is nothing"
    assert "degraded" in nodes
    assert "2 errors: &lt;b&gt;bang" in nodes
    assert "silent for 9 s" in nodes
    assert "25 %" in nodes
    quiet = {"camera": (status("camera", outputs=(port("stereo", rate_hz=0.0),)), 0.5)}
    assert "silent" in panels.topics_table(quiet)
    slow = {"camera": (status("camera", outputs=(port("stereo", rate_hz=3.0),)), 0.5)}
    assert "slow" in panels.topics_table(slow)


def test_the_banner_shouts_what_matters_most() -> None:
    follow = {"left": arm_state("left", edge_force_n=5.1), "right": arm_state("right")}
    assert "5.1 N" in panels.banner("cylinder", follow, None, "Live")
    fault = {"left": arm_state("left", mode="fault", faults=("joint 3",))}
    assert "left arm: fault (joint 3)" in panels.banner("cylinder", fault, None, "Live")
    assert "E-STOP is engaged: why" in panels.banner("cylinder", fault, "why", "Live")
    assert "Waiting" in panels.banner("cylinder", {}, None, "Live")
    assert panels.problem("") == ""
    assert "&lt;" in panels.problem("<")


@pytest.mark.parametrize(
    ("one", "other"),
    [
        *((color, "#ffffff") for color in (panels.TEXT, panels.QUIET, "#374151")),
        *((kind[0], "#ffffff") for kind in (panels.GOOD, panels.WARN, panels.BAD)),
        ("#991b1b", "#fef2f2"),
    ],
)
def test_text_stands_out_as_much_as_wcag_aa_asks(one: str, other: str) -> None:
    low, high = sorted((luminance(one), luminance(other)))
    assert (high + 0.05) / (low + 0.05) >= 4.5


def test_latencies_are_from_the_exposure_on() -> None:
    history = History()
    assert np.isnan(history.columns()[1]).all()
    shelf = Shelf(
        fingertip=fingertip(np.zeros(3)),
        arm_left=arm_state("left", target_source_ns=1_000_000, command_sent_ns=9_000_000),
        arm_right=arm_state("right"),
    )
    for second in range(40):
        history.take(float(second), shelf)
    times, *series = history.columns()
    assert (times[0], times[-1]) == (-WINDOW_S, 0.0)
    last = dict(zip(SERIES, (one[-1] for one in series), strict=True))
    assert last["finger found"] == pytest.approx(3.0)
    assert last["arm commanded"] == pytest.approx(8.0)
    assert np.isnan(last["frame drawn"])


def frames_of(message: Message, sequence: int = 1) -> tuple[list[Any], Header]:
    header = Header(sequence, 5, 6, "clock", "writer", 3)
    return encode(message, header), header


def test_only_what_is_looked_at_is_opened() -> None:
    refused: list[tuple[Topic, WireError]] = []
    newest = Newest(lambda topic, error: refused.append((topic, error)))
    assert newest.newest("estop", EStop) is None
    assert not newest.put("estop", frames_of(EStop(engaged=True, reason="1"))[0])
    assert newest.put("estop", frames_of(EStop(engaged=True, reason="2"))[0]), "never looked at"
    entry = newest.newest("estop", EStop)
    assert entry is not None
    assert entry[0].reason == "2"
    assert newest.newest("estop", EStop) is entry or newest.newest("estop", EStop) == entry
    newest.put("estop", [b"rubbish"])
    assert newest.newest("estop", EStop) == entry, "what came before still stands"
    assert [topic.name for topic, _ in refused] == ["estop"]
    with pytest.raises(TypeError):
        newest.newest("estop", Moment)


# Replay.


@pytest.fixture
def bag(tmp_path: Path, scene: Scene) -> Path:
    """Ten seconds of a finger that moves 1 mm a second, with a moment at 4 s."""
    path = tmp_path / "sub" / "a.mcap"
    path.parent.mkdir()
    start_ns = 1_000_000_000_000
    with BagWriter(path) as writer:

        def write(topic: str, message: Message, seconds: float) -> None:
            header = Header(1, start_ns, start_ns, "c", "w", 1)
            writer.write(TOPICS[topic], message, header, start_ns + round(seconds * 1e9))

        write("scene", scene, 0.0)
        for tenth in range(101):
            at = np.array([0.0, 0.0, 1e-4 * tenth])
            write("fingertip", fingertip(at), 0.1 * tenth)
            if tenth == 40:
                write("moment", Moment(label="touch"), 4.0)
    return path


def test_a_bag_is_shown_as_it_was_at_any_moment(bag: Path) -> None:
    timeline = Timeline(bag)
    assert timeline.duration_s == pytest.approx(10.0)
    assert timeline.moments == [(pytest.approx(4.0), "touch")]
    for seconds, height in ((0.05, 0.0), (10.0, 1e-2), (3.14, 3.1e-3), (0.0, 0.0)):
        timeline.seconds = seconds
        entry = timeline.newest("fingertip", Fingertip)
        assert entry is not None
        assert entry[0].position_world_m[2] == pytest.approx(height)
    assert timeline.newest("arm_left", ArmState) is None
    one, again = timeline.newest("scene", Scene), timeline.newest("scene", Scene)
    assert one is not None
    assert again is not None
    assert one[0] is again[0], "the scene is not drawn anew at each frame"
    timeline.seconds = -1.0
    assert timeline.newest("fingertip", Fingertip) is None
    assert bags_in(bag.parent.parent) == ["sub/a.mcap"]


def test_bags_that_cannot_be_shown_say_why(tmp_path: Path, bag: Path) -> None:
    with pytest.raises(BagError, match="cannot be read"):
        Timeline(tmp_path / "none.mcap")
    (tmp_path / "text.mcap").write_text("no bag")
    with pytest.raises(BagError, match="no MCAP"):
        Timeline(tmp_path / "text.mcap")
    with BagWriter(tmp_path / "stop.mcap") as writer:
        message = EStop(engaged=True, reason="")
        writer.write(TOPICS["estop"], message, Header(1, 1, 1, "c", "w", 1), 1)
    with pytest.raises(BagError, match="nothing in it"):
        Timeline(tmp_path / "stop.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(bag.read_bytes()[:-300])
    assert Timeline(cut).duration_s > 0.0


# The recorder that waits, and the plan with a console.


def names_in(folder: Path) -> list[Path]:
    return sorted(folder.iterdir())


async def test_a_recorder_that_waits_begins_a_bag_for_each_start(tmp_path: Path) -> None:
    names = ("estop", "recording", "display")
    node = Recorder(
        RecorderParameters(bag=tmp_path / "a.mcap", attach=(), waits=True),
        name="recorder",
        clock=VirtualClock(1000, clock_id="clock"),
        send=lambda topic, message, header: None,
        topics={f"in/{name}": name for name in names},
    )
    await node.setup()
    shown = Display(correction="none", stereo="mono")
    node.deliver("in/display", *frames_of(shown))
    node.deliver("in/estop", *frames_of(EStop(engaged=True, reason="before")))
    assert not names_in(tmp_path)
    for reason in ("first", "second"):
        node.deliver("in/recording", *frames_of(Recording(running=True)))
        node.deliver("in/recording", *frames_of(Recording(running=True)))
        node.deliver("in/estop", *frames_of(EStop(engaged=True, reason=reason)))
        node.deliver("in/recording", *frames_of(Recording(running=False)))
    node.deliver("in/estop", *frames_of(EStop(engaged=False, reason="after")))
    await node.close()
    assert node.inputs["in/estop"].counts.dropped == 0
    found = [list(BagReader(path)) for path in names_in(tmp_path)]
    said = [
        [message.reason for _, message, _, _ in entries if isinstance(message, EStop)]
        for entries in found
    ]
    # The e-stop is latched: whoever reads the bag must know it from its beginning.
    assert sorted(said) == [["before", "first"], ["first", "second"]]
    assert all(any(entry[0] == "display" for entry in entries) for entries in found)
    node.deliver("in/recording", *frames_of(Recording(running=False)))
    assert node.errors == 0


async def test_a_recorder_that_cannot_begin_says_so_and_goes_on(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    node = Recorder(
        RecorderParameters(bag=tmp_path / "file" / "a.mcap", attach=(), waits=True),
        name="recorder",
        clock=VirtualClock(),
        send=lambda topic, message, header: None,
        topics={"in/recording": "recording"},
    )
    await node.setup()
    node.deliver("in/recording", *frames_of(Recording(running=True)))
    assert node.errors == 1
    assert "NOT RECORDING" in node.note


@pytest.fixture
def graph(tmp_path: Path) -> Path:
    file = tmp_path / "graph.yaml"
    file.write_text(
        f"scene: {ROOT / 'launch/scenes/cylinder.yaml'}\n"
        "nodes:\n  twin_finger: {type: twin_finger}\n"
    )
    return file


def test_a_console_is_added_and_writes_the_scene(graph: Path) -> None:
    plan = load_plan(graph, console=True, settings=["console.page_port=8123"])
    assert [writer.name for writer in plan.writers["scene"]] == ["console"]
    assert plan.nodes["console"].nice > 0
    assert plan.nodes["console"].parameters["page_port"] == 8123
    assert plan.ports_of_its_own(None) == [("console", 8123)]
    assert plan.nodes["console"].parameters["drives_finger"]
    assert plan.nodes["recorder"].parameters["waits"]
    read = {port.topic for port in plan.nodes["console"].inputs}
    assert {"status", "estop", "display"} <= read
    assert "arm_left" not in read, "which nobody writes here"
    assert "recording" in {port.topic for port in plan.nodes["recorder"].inputs}
    without = load_plan(graph)
    assert [writer.name for writer in without.writers["scene"]] == ["launch"]


def test_what_the_file_says_of_console_and_recorder_stays(graph: Path, tmp_path: Path) -> None:
    text = graph.read_text()
    graph.write_text(text + "  page: {type: console, parameters: {page_port: 9}}\n")
    plan = load_plan(graph, console=True, record=tmp_path / "a.mcap")
    assert "console" not in plan.nodes
    assert plan.nodes["page"].parameters["page_port"] == 9
    assert not plan.nodes["recorder"].parameters["waits"]
    graph.write_text(text.replace("twin_finger: {type: twin_finger}", "fem_solver: {type: x:Y}"))
    with pytest.raises(BadInputError):
        load_plan(graph, console=True)
    open_page = "console.address=192.0.2.1"
    graph.write_text(text)
    with pytest.raises(BadInputError, match="token_file"):
        load_plan(graph, console=True, settings=[open_page])


async def test_an_object_is_made_ready_to_point_at_beside_the_loop(
    scene: Scene, tmp_path: Path
) -> None:
    sent: list[Message] = []
    desk = SceneDesk(sent.append, tmp_path, scene)
    finger, failures = Finger(sent.append, speed_m_per_s=1.0), []
    desk.make_aim(finger, failures.append)
    with pytest.raises(ValueError, match="still being read"):
        finger.lift()
    async with asyncio.timeout(20):
        while not sent:
            await asyncio.sleep(0)
            try:
                finger.lift()
            except ValueError:
                continue
            finger.advance(1.0, None)
    await desk.close()
    assert not failures
