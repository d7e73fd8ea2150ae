"""Render by ray tracing what the user's eye sees on the simulated sheet, to verify the display.

A virtual camera is placed at the eye. It views a square window about the origin of the screen plane
(z = 0). Each ray is intersected with the triangles of the sheet, and gets the colour that the
projector casts on this point. The expected image shows the virtual object itself and is rendered in
the same way. Sizes are measured in both images as in Furukawa et al. 2007.

"True" refers to the simulated devices. They may differ from the devices that the nodes assume. The
module shares no code with the renderer, because it is used to test the renderer.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from flexsheet.messages.apparatus import Apparatus
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.scene import Projector, Scene, require_projector
from flexsheet.messages.types import Skin, TwinArms
from flexsheet.nodes.arrays import Bools, Floats, Image
from flexsheet.nodes.models.rigid import apply, inverse, pose_matrix
from flexsheet.nodes.twin import rig
from flexsheet.nodes.twin.membrane import DeformedSheet
from flexsheet.nodes.twin.rig import slopes_of
from flexsheet.nodes.twin.sheet_pull import find_clamps, solve_sheet
from flexsheet.nodes.twin.true_object import TrueBody, TrueObject

Indices = NDArray[np.intp]

METRES_PER_PX = 0.00035
"""The default size of a pixel on the screen plane, in metres. The pixel size in Furukawa et al.
2007 is 0.7 mm."""

HALF_WINDOW_M = 0.12
MARGIN_PX = 3
SEEN_SAMPLES = 2

FLAT_SAMPLES, SOFT_SAMPLES = 8, 4
"""The number of samples per pixel along each axis of an expected image, with flat and soft shading.
Flat-shaded images need more samples, because sizes are measured at their outlines."""

SHADOW_TOLERANCE = 0.002
"""The minimum distance of a shadowed point behind the surface that shadows it, as a fraction of the
point's distance from the projector."""

LIGHT = np.array([-0.35, 0.6, 0.72]) / np.linalg.norm([-0.35, 0.6, 0.72])
AMBIENT, WRAP, SHEEN, SHEEN_EXPONENT = 0.25, 0.35, 0.10, 20.0
GLOW, DARKENING, HALF_DARK_M = np.array([0.16, 0.03, 0.02]), np.array([0.8, 1.0, 1.05]), 0.025
"""Three parameters of the shading of a soft object. docs/renderer.md describes all parameters."""


class NotMeasurableError(FlexsheetError, ValueError):
    """Raised if an image does not show the whole object that must be measured."""

    remedy = "Choose a pose in which the whole object is visible within the image."


@dataclass(frozen=True, slots=True)
class Rays:
    """The rays from a point `origin` through the pixels of an image.

    The direction of a ray is first + column * right + row * down. All vectors have the shape (3,).
    """

    origin: Floats
    first: Floats
    right: Floats
    down: Floats
    width: int
    height: int

    def directions(self) -> Floats:
        """Return the directions (height, width, 3) of all rays, without normalization."""
        columns, rows = np.arange(self.width), np.arange(self.height)
        return self.first + columns[None, :, None] * self.right + rows[:, None, None] * self.down


@dataclass(frozen=True, slots=True)
class Hits:
    """The first intersection of each ray through an image with a mesh.

    triangle (height, width): index of the triangle that the ray hits; -1 if there is no hit.
    inverse_range (height, width): reciprocal of the ray parameter at the hit; 0 if there is no hit.
    weights (triangles, 3, 3): matrices that map (1, column, row) to unnormalized barycentric
        weights.
    """

    triangle: NDArray[np.int32]
    inverse_range: Floats
    weights: Floats


def first_hits(rays: Rays, vertices: Floats, triangles: Indices) -> Hits:
    """Find the first triangle that each ray hits.

    rays: rays from one origin through the pixels of an image.
    vertices (v, 3): positions, m.
    triangles (t, 3): indices of vertices.

    A ray direction is d = sum of w_i (vertex_i - origin) over the corners of a triangle. The ray
    hits the triangle if all w_i >= 0, at the ray parameter 1 / sum(w). The weights w_i are linear
    functions of the pixel's column and row. Triangles that extend behind the origin, or whose plane
    contains the origin, are ignored.
    """
    corners = (vertices - rays.origin)[triangles]
    basis = np.column_stack([rays.first, rays.right, rays.down])
    volume = np.einsum("ti,ti->t", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    size = np.linalg.norm(corners, axis=2).prod(axis=1)
    # Corners in the fan's coordinates: (1, column, row) times a depth.
    pixels = corners @ np.linalg.inv(basis).T
    ahead = (pixels[..., 0] > 1e-9).all(axis=1) & (np.abs(volume) > 1e-12 * size)
    weights = np.zeros((len(triangles), 3, 3))
    weights[ahead] = np.linalg.inv(corners[ahead].transpose(0, 2, 1)) @ basis
    at = pixels[..., 1:] / np.where(ahead, 1.0, np.nan)[:, None, None] / pixels[..., :1]
    limit = np.array([rays.width - 1, rays.height - 1])
    low, high = np.ceil(at.min(axis=1) - 1e-6), np.floor(at.max(axis=1) + 1e-6)
    ahead &= (high >= 0).all(axis=1) & (low <= limit).all(axis=1) & (high >= low).all(axis=1)
    chosen = np.nonzero(ahead)[0]
    low = np.clip(low[chosen], 0, limit).astype(int)
    high = np.clip(high[chosen], 0, limit).astype(int) + 1

    nearest = np.zeros((rays.height, rays.width))
    triangle = np.full((rays.height, rays.width), -1, np.int32)
    columns, rows = np.arange(rays.width, dtype=float), np.arange(rays.height, dtype=float)[:, None]
    for index, (c0, r0), (c1, r1) in zip(chosen, low, high, strict=True):
        (a, b, c), x, y = weights[index].T, columns[c0:c1], rows[r0:r1]
        w0 = (a[0] + b[0] * x) + c[0] * y
        w1 = (a[1] + b[1] * x) + c[1] * y
        w2 = (a[2] + b[2] * x) + c[2] * y
        total = w0 + w1 + w2
        here = nearest[r0:r1, c0:c1]
        hit = (np.minimum(np.minimum(w0, w1), w2) >= -1e-9 * total) & (total > here)
        here[hit] = total[hit]
        triangle[r0:r1, c0:c1][hit] = index
    return Hits(triangle, nearest, weights)


class TrueProjector:
    """A simulated projector that maps its pixels to the points of the sheet and back."""

    def __init__(self, projector: Projector, vertices: Floats, triangles: Indices) -> None:
        """Compute the rays of a projector that illuminates a sheet.

        vertices (v, 3): vertices of the sheet, world frame, m.
        triangles (t, 3): vertex indices.
        """
        self._world_from_projector = pose_matrix(projector.world_from_projector)
        self._lens = lens = projector.lens
        self._size = np.array([projector.width_px, projector.height_px])
        # The rays are those of a lens without distortion. A margin contains the pixels that
        # distortion moves out of the undistorted image.
        edge = np.array([(x, y) for x in np.linspace(0, 1, 9) for y in np.linspace(0, 1, 9)])
        border = edge * (self._size - 1)
        self._margin = 0
        if any(lens.distortion):
            self._margin = int(np.ceil(np.abs(self._straight(border) - border).max())) + 2
        rotation = self._world_from_projector[:3, :3]
        start = -np.array([lens.cx_px, lens.cy_px]) - self._margin
        corner = np.array([start[0] / lens.fx_px, start[1] / lens.fy_px, 1.0])
        self._rays = Rays(
            origin=self._world_from_projector[:3, 3],
            first=rotation @ corner,
            right=rotation[:, 0] / lens.fx_px,
            down=rotation[:, 1] / lens.fy_px,
            width=projector.width_px + 2 * self._margin,
            height=projector.height_px + 2 * self._margin,
        )
        self._vertices, self._triangles = vertices, triangles

    @cached_property
    def _hits(self) -> Hits:
        return first_hits(self._rays, self._vertices, self._triangles)

    def _straight(self, pixels: Floats) -> Floats:
        """Remove the effect of lens distortion from pixel positions (..., 2)."""
        lens = self._lens
        if not any(lens.distortion):
            return pixels
        focal, centre = np.array([lens.fx_px, lens.fy_px]), np.array([lens.cx_px, lens.cy_px])
        return np.asarray(slopes_of(lens, pixels) * focal + centre)

    def pixels_of(self, points: Floats) -> tuple[Floats, Bools]:
        """Return the projector pixels (..., 2) of world points (..., 3), and a mask of lit points.

        A point is lit if it lies within the projected image and not in the shadow of the sheet.
        """
        local = apply(inverse(self._world_from_projector), points)
        depth = local[..., 2]
        ahead = depth > 1e-6
        share = 1.0 / np.where(ahead, depth, 1.0)
        slopes = local[..., :2] * share[..., None]
        pixels = rig.pixels_of(self._lens, slopes)
        nearest = np.rint(pixels)
        inside = ahead & ((nearest >= 0) & (nearest < self._size)).all(axis=-1)
        lens = self._lens
        straight = slopes * [lens.fx_px, lens.fy_px] + [lens.cx_px, lens.cy_px] + self._margin
        at = np.where(inside[..., None], np.rint(straight), 0).astype(int)
        first = self._hits.inverse_range[at[..., 1], at[..., 0]]
        lit = inside & (share >= first * (1.0 - SHADOW_TOLERANCE))
        return pixels, lit

    def intersect_surface(self, pixels: Floats) -> tuple[Floats, Bools]:
        """Return the points (n, 3) of the sheet that pixels (n, 2) illuminate, and a mask (n,).

        The mask is False if a pixel is outside the image or if its ray misses the sheet.
        """
        inside: Bools = np.all((pixels >= -0.5) & (pixels <= self._size - 0.5), axis=1)
        places = self._straight(np.where(inside[:, None], pixels, 0.0)) + self._margin
        limit = np.array([self._rays.width - 1, self._rays.height - 1])
        at = np.clip(np.rint(places), 0, limit).astype(int)
        triangle = self._hits.triangle[at[:, 1], at[:, 0]]
        inside &= triangle >= 0
        ones = np.column_stack([np.ones(len(places)), places])
        total = np.einsum("nij,nj->n", self._hits.weights[triangle], ones)
        inside &= total > 0.0
        rays = self._rays
        directions = rays.first + places[:, :1] * rays.right + places[:, 1:] * rays.down
        return rays.origin + directions / np.where(inside, total, 1.0)[:, None], inside


Box = tuple[int, int, int, int]
"""A rectangular part of an image: first column, first row, last column + 1, last row + 1."""


def eye_rays(eye: Floats, *, metres_per_px: float, size: int, box: Box, samples: int) -> Rays:
    """Return the rays from the eye (3,) through the part `box` of the eye's square image.

    The whole image has `size` x `size` pixels. Each pixel has `samples` x `samples` rays. The first
    ray is at the top left.
    """
    left, top, right, bottom = box
    pitch = metres_per_px / samples
    edge = 0.5 * size * metres_per_px - 0.5 * pitch
    corner = np.array([-edge + left * metres_per_px, edge - top * metres_per_px, 0.0])
    return Rays(
        origin=eye,
        first=corner - eye,
        right=np.array([pitch, 0.0, 0.0]),
        down=np.array([0.0, -pitch, 0.0]),
        width=(right - left) * samples,
        height=(bottom - top) * samples,
    )


def seen(
    projected: Image,
    sheet: DeformedSheet,
    scene: Scene,
    *,
    eye: Floats,
    metres_per_px: float = METRES_PER_PX,
) -> Image:
    """Render the image (rows, columns, 3) that a camera at the eye takes of the sheet.

    projected: projected image (height, width, 3).
    eye (3,): position, m.

    A pixel is black if its rays miss the sheet, or if another part of the sheet blocks the light.
    """
    vertices, triangles = sheet.positions.reshape(-1, 3), sheet.triangles()
    projector = TrueProjector(require_projector(scene), vertices, triangles)
    size = round(2.0 * HALF_WINDOW_M / metres_per_px)
    whole = np.zeros((size, size, 3), np.uint8)
    # Only the lit part is traced, since nothing else is visible.
    bright = np.argwhere(projected.any(axis=2))[:, ::-1].astype(np.float64)
    points, lands = projector.intersect_surface(bright)
    lands &= points[:, 2] < eye[2] - 1e-3
    box = _box(points[lands], eye, metres_per_px, size)
    if box is None:
        return whole
    rays = eye_rays(eye, metres_per_px=metres_per_px, size=size, box=box, samples=SEEN_SAMPLES)
    hits = first_hits(rays, vertices, triangles)
    hit = hits.triangle >= 0
    points = rays.origin + rays.directions()[hit] / hits.inverse_range[hit][:, None]
    pixels, lit = projector.pixels_of(points)
    where = np.full((rays.height, rays.width, 2), -10.0, np.float32)
    where[hit] = np.where(lit[:, None], pixels, -10.0)
    sampled = cv2.remap(
        projected, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
    )
    _put(whole, box, sampled.astype(np.float32), SEEN_SAMPLES)
    return whole


def _box(points: Floats, eye: Floats, metres_per_px: float, size: int) -> Box | None:
    """Return the part of the eye's image that shows world points (n, 3), with a margin.

    Returns None if the image shows none of the points.
    """
    if len(points) == 0:
        return None
    on_screen = eye[:2] + (points[:, :2] - eye[:2]) * (eye[2] / (eye[2] - points[:, 2:]))
    span = on_screen / metres_per_px * [1.0, -1.0] + 0.5 * size
    left, top = np.clip(np.floor(span.min(axis=0)).astype(int) - MARGIN_PX, 0, size)
    right, bottom = np.clip(np.ceil(span.max(axis=0)).astype(int) + MARGIN_PX, 0, size)
    if right <= left or bottom <= top:
        return None
    return int(left), int(top), int(right), int(bottom)


def _put(whole: Image, box: Box, samples_of: NDArray[np.float32], samples: int) -> None:
    """Average the samples of each pixel and store the result in the part `box` of an image."""
    left, top, right, bottom = box
    blocks = samples_of.reshape(bottom - top, samples, right - left, samples, -1)
    whole[top:bottom, left:right] = np.rint(blocks.mean(axis=(1, 3)))


def render_expected(
    true_object: TrueObject,
    *,
    eye: Floats,
    flat: bool,
    metres_per_px: float = METRES_PER_PX,
) -> Image:
    """Render the expected image (rows, columns, 3): the virtual object on a black background.

    Raises ValueError unless the whole object lies in front of the eye.
    """
    if (true_object.vertices[:, 2] > eye[2] - 1e-3).any():
        raise ValueError(
            "a part of the virtual object is not in front of the eye; move the object or the eye"
        )
    vertices, triangles = true_object.vertices, true_object.triangles
    size = round(2.0 * HALF_WINDOW_M / metres_per_px)
    whole = np.zeros((size, size, 3), np.uint8)
    # Only the object's own part of the image is traced, which allows fine sampling.
    box = _box(vertices, eye, metres_per_px, size)
    if box is None:
        return whole
    samples = FLAT_SAMPLES if flat else SOFT_SAMPLES
    rays = eye_rays(eye, metres_per_px=metres_per_px, size=size, box=box, samples=samples)
    corners = vertices[triangles]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    front = triangles[np.einsum("ti,ti->t", outward, eye - corners[:, 0]) > 0.0]
    hits = first_hits(rays, vertices, front)
    hit = hits.triangle >= 0
    if flat:
        picture = 255.0 * hit[..., None].astype(np.float32)
    else:
        picture = np.zeros((rays.height, rays.width, 3), np.float32)
        row, column = np.nonzero(hit)
        index = hits.triangle[hit]
        ones = np.column_stack([np.ones(len(row)), column, row])
        weights = np.einsum("nij,nj->ni", hits.weights[index], ones)
        weights /= weights.sum(axis=1, keepdims=True)
        corners = front[index]
        picture[hit] = 255.0 * _soft(
            true_object.colour,
            normals=np.einsum("ni,nij->nj", weights, true_object.normals[corners]),
            to_eye=eye - np.einsum("ni,nij->nj", weights, vertices[corners]),
            sunk_m=np.einsum("ni,ni->n", weights, true_object.sunk_m[corners]),
        ).clip(0.0, 1.0)
    _put(whole, box, picture, samples)
    return whole


def _soft(colour: Floats, *, normals: Floats, to_eye: Floats, sunk_m: Floats) -> Floats:
    """Return the colours (n, 3), from 0 to 1, of points on a soft object without a texture.

    colour (3,): colour of the object.
    normals (n, 3): unit normals.
    to_eye (n, 3): vectors from the points to the eye.
    sunk_m (n,): depths to which the points are pushed in, m.
    """
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    half = to_eye / np.linalg.norm(to_eye, axis=1, keepdims=True) + LIGHT
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    wrapped = np.maximum((normals @ LIGHT + WRAP) / (1.0 + WRAP), 0.0)[:, None]
    dark = (1.0 / (1.0 + np.maximum(sunk_m, 0.0) / HALF_DARK_M))[:, None] ** DARKENING
    sheen = np.maximum(np.einsum("ni,ni->n", normals, half), 0.0)[:, None] ** SHEEN_EXPONENT
    light = AMBIENT + (1.0 - AMBIENT) * wrapped + GLOW * 4.0 * wrapped * (1.0 - wrapped)
    return np.asarray((colour * light + SHEEN * sheen) * dark)


class _Silhouette:
    """The outline of the largest bright region of an image."""

    def __init__(self, picture: Image) -> None:
        gray = picture.astype(np.float64).mean(axis=2)
        bright = gray[gray > 25.0]
        if len(bright) < 400:
            raise NotMeasurableError(
                f"only {len(bright)} pixels of the eye's image are lit; at least 400 are required"
            )
        self.white = float(np.quantile(bright, 0.9))
        mask = (gray > 0.5 * self.white).astype(np.uint8)
        _, labels, statistics, _ = cv2.connectedComponentsWithStats(mask)
        largest = 1 + int(np.argmax(statistics[1:, cv2.CC_STAT_AREA]))
        left, top, width, height, area = statistics[largest]
        if area < 400:
            raise NotMeasurableError(
                f"the largest bright region of the eye's image has only {area} pixels; at least "
                "400 are required"
            )
        if left == 0 or top == 0 or left + width == mask.shape[1] or top + height == mask.shape[0]:
            raise NotMeasurableError("the object reaches the border of the eye's image")
        # Remove other regions. The margin keeps the partly bright pixels at the edge.
        keep = cv2.dilate((labels == largest).astype(np.uint8), np.ones((9, 9), np.uint8))
        self._gray = np.where(keep > 0, gray, 0.0) / self.white
        self.middle_column = left + 0.5 * (width - 1)
        self.middle_row = top + 0.5 * (height - 1)

    def rows_of_column(self, column: float) -> tuple[float, float]:
        """Return the first and the last row (px, subpixel) of the object at a fractional column."""
        return self._ends_between(self._gray.T, column)

    def columns_of_row(self, row: float) -> tuple[float, float]:
        """Return the first and the last column (px, subpixel) of the object at a fractional row."""
        return self._ends_between(self._gray, row)

    def _ends_between(self, lines: Floats, at: float) -> tuple[float, float]:
        before = int(np.floor(at))
        share = at - before
        first, second = _ends(lines[before]), _ends(lines[before + 1])
        return (
            (1 - share) * first[0] + share * second[0],
            (1 - share) * first[1] + share * second[1],
        )


def _ends(profile: Floats) -> tuple[float, float]:
    """Return the subpixel positions of both ends of the bright part of a grey-level profile.

    An edge is located where a sharp step would give the same total light. This position is exact
    for any symmetric blur. Raises NotMeasurableError if the bright part is too short.
    """
    bright = np.nonzero(profile > 0.5)[0]
    if len(bright) < 12:
        raise NotMeasurableError(
            f"the object is only {len(bright)} pixels wide in the eye's image; at least 12 pixels "
            "are required to measure its edges"
        )
    return _edge(profile, bright[0]), len(profile) - 1 - _edge(
        profile[::-1], len(profile) - 1 - bright[-1]
    )


def _edge(profile: Floats, first: int) -> float:
    reach = 5
    low, high = max(first - reach, 0), first + reach
    plateau = float(np.median(profile[first + 2 : high + 1]))
    return high + 0.5 - float(profile[low : high + 1].sum()) / max(plateau, 1e-6)


INSET = 0.05
"""The distance from the upper and lower edge of the tilted cylinder at which its widths are
measured, as a fraction of its height. At this distance, the rounded corners have no influence."""

MIDDLE_COLUMNS = 17
"""The number of columns about the centre over which a measured height is averaged."""


def _height(shape: _Silhouette) -> tuple[float, float]:
    offsets = np.arange(MIDDLE_COLUMNS) - MIDDLE_COLUMNS // 2
    rows = np.array([shape.rows_of_column(shape.middle_column + offset) for offset in offsets])
    top, bottom = rows.mean(axis=0)
    return float(top), float(bottom)


def tilt_sizes(picture: Image, metres_per_px: float) -> tuple[float, float, float]:
    """Measure height, upper width and lower width (m) of a cylinder in a flat-shaded image.

    The method is described in Furukawa et al. 2007, section VI-B. Raises NotMeasurableError if the
    cylinder is cut off, interrupted or missing.
    """
    shape = _Silhouette(picture)
    top, bottom = _height(shape)
    inset = INSET * (bottom - top)
    upper = shape.columns_of_row(top + inset)
    lower = shape.columns_of_row(bottom - inset)
    return (
        (bottom - top) * metres_per_px,
        (upper[1] - upper[0]) * metres_per_px,
        (lower[1] - lower[0]) * metres_per_px,
    )


def push_sizes(picture: Image, metres_per_px: float) -> tuple[float, float]:
    """Measure height and width (m) of a cylinder at its centre in a flat-shaded image.

    The method is described in Furukawa et al. 2007, section VI-C. Raises NotMeasurableError if the
    cylinder is cut off, interrupted or missing.
    """
    shape = _Silhouette(picture)
    top, bottom = _height(shape)
    left, right = shape.columns_of_row(0.5 * (top + bottom))
    return (bottom - top) * metres_per_px, (right - left) * metres_per_px


@dataclass(frozen=True, slots=True)
class EyeSituation:
    """The true state of the simulated hardware and of the object while a frame is shown.

    scene: scene with the true parameters of the devices.
    finger_tip: position (3,) of the fingertip in the world frame, m; None if there is no finger.
    skin: surface mesh of the soft body at rest, with v vertices.
    displacement: displacement (v, 3) of the skin, m. Skin and displacement are None if the object
        is not deformed.
    flat: whether the object is shown in one colour, without shading.
    """

    scene: Scene
    apparatus: Apparatus | None
    arms: TwinArms
    finger_tip: Floats | None
    skin: Skin | None
    displacement: NDArray[np.float32] | None
    flat: bool
    metres_per_px: float


class EyeCamera:
    """A simulated camera at the user's eye that measures errors of the displayed image.

    It caches the image that a perfect display would show.
    """

    def __init__(self) -> None:
        self._scene: Scene | None = None
        self._body: TrueBody | None = None
        self._expected: tuple[tuple[bytes, ...], Image] | None = None

    def take(
        self, projected: Image, situation: EyeSituation, *, eye: Floats
    ) -> tuple[Image, Image]:
        """Render the image that the eye sees of a projected frame, and the expected image.

        Both images have the shape (rows, columns, 3). Raises NotConvergedError if the computation
        of the sheet's shape fails. Raises ValueError if the object reaches the eye or its
        deformation is invalid.
        """
        scene, arms, scale = situation.scene, situation.arms, situation.metres_per_px
        left, right = find_clamps(scene)
        edges = arms.world_from_flange_left @ left, arms.world_from_flange_right @ right
        sheet = solve_sheet(scene, situation.apparatus, edges, situation.finger_tip)
        return (
            seen(projected, sheet, scene, eye=eye, metres_per_px=scale),
            self._expected_image(situation, eye),
        )

    def _expected_image(self, situation: EyeSituation, eye: Floats) -> Image:
        if self._body is None or self._scene is not situation.scene:
            self._scene, self._body = situation.scene, TrueBody(situation.scene)
            self._expected = None
        skin, moved = situation.skin, situation.displacement
        settings = np.array([*eye, situation.flat, situation.metres_per_px])
        key: tuple[bytes, ...] = (settings.tobytes(),)
        deformation = None
        if skin is not None and moved is not None and moved.any():
            vertices = skin.vertices_world_m
            key += (vertices.tobytes(), moved.tobytes())
            deformation = vertices.astype(np.float64), skin.triangles, moved.astype(np.float64)
        if self._expected is None or self._expected[0] != key:
            body = self._body
            true_object = body.displaced(*deformation) if deformation else body.at_rest()
            picture = render_expected(
                true_object, eye=eye, flat=situation.flat, metres_per_px=situation.metres_per_px
            )
            self._expected = key, picture
        return self._expected[1]
