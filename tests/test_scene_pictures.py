"""Test for every shipped scene that the eye sees the image that the simulator expects."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path

import moderngl
import numpy as np
import pytest
from numpy.typing import NDArray

from flexsheet.launch.plans.plan import load_scene
from flexsheet.messages.base import Header, Message
from flexsheet.messages.clock import VirtualClock
from flexsheet.messages.scene import Scene
from flexsheet.messages.topics import Topic
from flexsheet.messages.types import Display, Frame, Shading, Skin, SoftBody, TwinArms, TwinEye
from flexsheet.nodes.models.rigid import inverse, pose_matrix
from flexsheet.nodes.models.sheet import edge_poses
from flexsheet.nodes.renderer.gl import headless_context
from flexsheet.nodes.renderer.node import Renderer, RendererParameters
from flexsheet.nodes.renderer.object_surface import DeformationTransfer, VertexNormals
from flexsheet.nodes.renderer.scene_renderer import SceneRenderer
from flexsheet.nodes.twin.eye_node import TwinEyeNode, TwinEyeParameters
from flexsheet.nodes.twin.true_object import TrueBody
from tests.examples import long_except
from tests.fingertips import fingertip

Floats = NDArray[np.float64]
SCENES = [
    path
    for path in sorted((Path(__file__).parents[1] / "launch" / "scenes").glob("*.yaml"))
    if "\nprojector:" in path.read_text()
]
SAME_OBJECTS = ("demanding", "light-touch", "palpation")
"""Scenes with the object of another scene, and another working range, tolerances or methods."""
IN_LONG_TESTS = (*SAME_OBJECTS, "ellipsoid")
"""The ellipsoid, too, is a smooth solid, as sphere and cylinder are."""
SHIFT_M = np.array([0.004, 0.006, -0.008])


@dataclass
class Case:
    """A scene, its renderer, and a skin that is coarser than the drawn surface."""

    scene: Scene
    stage: SceneRenderer
    skin: Skin

    def body(self, displacement: Floats) -> SoftBody:
        return SoftBody(
            mesh_id=self.skin.mesh_id,
            method="linear",
            in_range=True,
            push_depth_m=0.0,
            force_world_n=np.zeros(3),
            stiffness_n_per_m=0.0,
            displacement_world_m=displacement.astype(np.float32),
        )

    def dent(self, depth_m: float, place: tuple[float, float] = (0.0, 0.0)) -> Floats:
        """Return the displacement (skin vertices, 3) of a steep indentation from the front."""
        points = self.skin.vertices_world_m.astype(np.float64)
        away = np.linalg.norm(points[:, :2] - np.array(place), axis=1)
        facing = (points[:, 2] - points[:, 2].min()) / np.ptp(points[:, 2])
        if self.scene.object.geometry.shape == "plane":
            facing[:] = 1.0
        depth = depth_m * facing * np.exp(-((away / 0.02) ** 2))
        return np.column_stack([np.zeros((len(points), 2)), -depth])


@pytest.fixture(scope="module")
def context() -> moderngl.Context:
    return headless_context()


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(
            path, id=path.stem, marks=pytest.mark.long if path.stem in IN_LONG_TESTS else ()
        )
        for path in SCENES
    ],
)
def case(request: pytest.FixtureRequest, context: moderngl.Context) -> Case:
    scene = load_scene(request.param)
    stage = SceneRenderer(scene, context, spacing_m=0.003)
    # As a solver's skin: coarser, on the true surface, its facets inside.
    coarse = SceneRenderer(scene, context, spacing_m=0.006)
    surface = coarse._surface
    skin = Skin(
        mesh_id="m",
        vertices_world_m=surface.rest_world_m.astype(np.float32),
        triangles=surface.triangles,
    )
    return Case(scene, stage, skin)


def cross_products(points: Floats, triangles: NDArray[np.integer]) -> Floats:
    a, b, c = (points[triangles[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


def test_the_drawn_surface_is_the_objects_own(case: Case) -> None:
    """The drawn mesh is on the true shape, oriented outwards, and has the volume of the object."""
    surface = case.stage._surface
    points, triangles = surface.rest_world_m, surface.triangles
    area = cross_products(points, triangles)
    assert (np.einsum("ij,ij->i", area, surface.normals_world[triangles].mean(axis=1)) > 0).all()
    assert np.allclose(np.linalg.norm(surface.normals_world, axis=1), 1.0)
    local = points @ inverse(case.stage._world_from_object)[:3, :3].T
    local = local + inverse(case.stage._world_from_object)[:3, 3]
    assert np.abs(case.stage._shape.signed_distance(local)).max() < 1e-6
    true = TrueBody(case.scene).at_rest()

    def volume(points: Floats, triangles: NDArray[np.integer]) -> float:
        middle = points.mean(axis=0)
        return float(np.sum((points - middle)[triangles[:, 0]] * cross_products(points, triangles)))

    assert volume(points, triangles) == pytest.approx(
        volume(true.vertices, true.triangles), rel=3e-3, abs=1e-12
    )
    assert np.abs(np.ptp(points, axis=0) - np.ptp(true.vertices, axis=0)).max() < 2e-4


def test_an_indentation_is_followed_without_inverted_triangles(case: Case) -> None:
    surface, body = case.stage._surface, case.body(case.dent(0.02, (0.005, -0.004)))
    follower = DeformationTransfer(
        surface, case.skin.vertices_world_m.astype(float), case.skin.triangles
    )
    moved = follower.apply(body.displacement_world_m).astype(np.float64)
    before = cross_products(surface.rest_world_m, surface.triangles)
    after = cross_products(moved[:, :3], surface.triangles)
    # Pushed along z, what faced the user still does.
    front = before[:, 2] > 0.05 * np.linalg.norm(before, axis=1)
    assert (after[front, 2] > 0.0).all()
    assert np.ptp(surface.rest_world_m[:, 2] - moved[:, 2]) > 0.015
    # The interpolated normals are those of the drawn triangles, but for the skin's facets.
    exact = VertexNormals(surface.triangles, len(moved))(moved[:, :3])
    used = np.unique(surface.triangles[front])
    fast = moved[used, 3:] / np.linalg.norm(moved[used, 3:], axis=1, keepdims=True)
    cosines = np.clip(np.einsum("ij,ij->i", fast, exact[used]), -1.0, 1.0)
    assert np.degrees(np.arccos(np.quantile(cosines, 0.1))) < 6.0


def test_the_simulated_body_follows_the_same_indentation(case: Case) -> None:
    """Compare the deformed fronts of the drawn and the simulated object."""
    true, displacement = TrueBody(case.scene), case.dent(0.02)
    vertices, triangles = case.skin.vertices_world_m.astype(float), case.skin.triangles
    rigid = true.displaced(vertices, triangles, np.tile(SHIFT_M, (len(vertices), 1)))
    assert np.allclose(rigid.vertices - true.at_rest().vertices, SHIFT_M)
    moved = true.displaced(vertices, triangles, displacement)
    follower = DeformationTransfer(case.stage._surface, vertices, triangles)
    drawn = follower.apply(displacement.astype(np.float32))
    for points in (moved.vertices, drawn[:, :3]):
        middle = points[np.linalg.norm(points[:, :2], axis=1) < 0.004]
        assert middle[:, 2].max() == pytest.approx(
            lowest(case, displacement),
            abs=1e-3,
        )
    with pytest.raises(ValueError, match="the displacement has 5 vertices, but the skin has"):
        true.displaced(vertices, triangles, displacement[:5])
    with pytest.raises(ValueError, match="all triangles of the skin have zero area"):
        true.displaced(vertices + 1.0, triangles[:0], displacement)


def lowest(case: Case, displacement: Floats) -> float:
    """Return the height (m) of the deformed skin near its middle."""
    points = case.skin.vertices_world_m + displacement
    return float(points[np.linalg.norm(points[:, :2], axis=1) < 0.006, 2].max())


class Chain:
    """A renderer and a simulated eye, with a clock that the test advances."""

    def __init__(self, case: Case) -> None:
        self.scene, self.clock = case.scene, VirtualClock(10**10)
        self.frames: list[Frame] = []
        self.pictures: list[TwinEye] = []
        edges = zip(
            edge_poses(np.eye(4), 0.25), (case.scene.arms.left, case.scene.arms.right), strict=True
        )
        left, right = (edge @ inverse(pose_matrix(arm.flange_from_edge)) for edge, arm in edges)
        self.arms = TwinArms(
            joints_left_rad=np.zeros(6),
            joints_right_rad=np.zeros(6),
            world_from_flange_left=left,
            world_from_flange_right=right,
        )
        self.renderer = Renderer(
            RendererParameters(spacing_m=0.003, cache_dir=Path("/nonexistent")),
            name="renderer",
            clock=self.clock,
            send=self._send,
        )
        self.eye = TwinEyeNode(
            TwinEyeParameters(metres_per_px=0.001),
            name="twin_eye",
            clock=self.clock,
            send=self._send,
        )

    def _send(self, topic: Topic, message: Message, header: Header) -> None:
        if isinstance(message, Frame):
            self.frames.append(message)
        elif isinstance(message, TwinEye):
            self.pictures.append(message)

    async def step(self, port: str, message: Message) -> None:
        now = self.clock.now_ns()
        for node in (self.renderer, self.eye):
            if port in node.inputs:
                await node.step(port, message, Header(1, now, now, "virtual", "test", 1))
                assert node.errors == 0, node.last_error

    async def picture(self, shading: Shading, *messages: tuple[str, Message]) -> TwinEye:
        """Return the seen and the expected image for an upright sheet and resting arms."""
        display = Display(
            correction="two_pass",
            stereo="mono",
            shading=shading,
            marks=False,
            pixels_every=1,
            label=f"{shading} {len(self.pictures)}",
        )
        await self.step("display", display)
        for port, message in messages:
            await self.step(port, message)
        self.clock.move_to(self.clock.now_ns() + 10**8)
        await self.step("fingertip", fingertip(np.array([0.0, 0.0, 0.1])))
        await self.step("twin__arms", self.arms)
        await self.step("frame", self.frames[-1])
        self.clock.move_to(self.clock.now_ns() + 10**8)
        await self.step("twin__arms", self.arms)
        assert self.eye._task is not None
        await self.eye._task
        assert self.eye.errors == 0, self.eye.last_error
        return self.pictures[-1]


@pytest.fixture
async def chain(case: Case) -> AsyncIterator[Chain]:
    chain = Chain(case)
    await chain.renderer.setup()
    await chain.eye.setup()
    await chain.step("scene", case.scene)
    yield chain
    await chain.renderer.close()
    await chain.eye.close()


@pytest.mark.parametrize(
    "case",
    long_except(SCENES, *(path for path in SCENES if path.stem in ("cylinder", "organ"))),
    indirect=True,
    ids=lambda path: path.stem,
)
async def test_the_eye_sees_what_it_ought_to(chain: Chain) -> None:
    picture = await chain.picture("flat")
    seen, expected = picture.seen[..., 0] / 255.0, picture.expected[..., 0] / 255.0
    assert expected.sum() > 3000  # mm^2
    assert seen.sum() == pytest.approx(expected.sum(), rel=3e-3)
    assert np.abs(seen - expected).sum() < 0.015 * expected.sum()
    for axis in (0, 1):
        width, wanted = (each.max(axis=axis).sum() for each in (seen, expected))
        assert width == pytest.approx(wanted, abs=0.5)


@pytest.mark.long
@pytest.mark.parametrize("case", [path for path in SCENES if path.stem == "organ"], indirect=True)
async def test_a_deformed_object_is_seen_as_deformed(chain: Chain, case: Case) -> None:
    rest = await chain.picture("soft")
    body = case.body(case.dent(0.02) + SHIFT_M)
    moved = await chain.picture("soft", ("skin", case.skin), ("soft_body", body))
    off = np.abs(moved.seen.astype(float) - moved.expected)
    assert off.mean() < 0.03 * moved.expected.mean()
    assert (np.abs(moved.expected.astype(float) - rest.expected) > 40).mean() > 0.005
