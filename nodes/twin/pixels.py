"""Simulate the stereo camera: render images of a finger with a bright marker at its tip.

The camera model (module `rig`) is a pinhole with Brown's distortion. It shares no code with the
camera model of the nodes, because the images are used to test the nodes. The finger is a tapered
capsule. By default, the marker is a small luminous bead at the fingertip. The module `nail` defines
other markers. The module `clutter` describes the surroundings. All objects are drawn pixel by
pixel. They are blurred by the lens, defocus, pixel area and motion during the exposure. Then photon
and read noise are added, and the result is clipped and rounded to grey levels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
import scipy

from flexsheet.messages.scene import Lens, StereoCamera
from flexsheet.messages.types import Side
from flexsheet.nodes.arrays import Floats, Image, Singles
from flexsheet.nodes.models.rigid import apply, inverse, pose_matrix
from flexsheet.nodes.twin.clutter import (
    CLUTTER,
    FINGER_LENGTH_M,
    MARKER_RADIUS_M,
    Clutter,
    FixedPoint,
    Highlight,
    SecondMarker,
    Sheet,
)
from flexsheet.nodes.twin.nail import Nail
from flexsheet.nodes.twin.rig import pixels_of, pixels_per_slope, project_ray, slopes_of

Window = tuple[slice, slice]
"""The rows and columns of a rectangular part of an image."""

Position = Callable[[float], Floats]
"""A function that returns the fingertip position (3,), m, at a time (s) since mid-exposure."""

MOTION_STEP_PX = 0.7
"""The maximum distance (px) between the positions at which a moving object is drawn during one
exposure. The lens blur closes the gaps. The motion within a step, which is ignored, would increase
this blur by at most 4 %."""

MAX_MOTION_STEPS = 1000
"""The maximum number of positions at which a moving object is drawn during one exposure. They cover
700 px, which a finger passes in 4 ms at more than 30 m/s."""

LIGHT = np.array([-0.6, 0.7, 0.4])
"""The direction (world frame, about unit length) towards the lamp at the upper left."""

SHADE = 0.35
"""The fraction by which skin is darker at the outline of a limb than on the centre line."""

SIDE_LIGHT = 0.2
"""The fraction by which the lamp brightens the facing side of a limb and darkens the other side."""

MIN_DEPTH_M = 0.02
"""The minimum distance (m) of drawn objects from a camera."""

ALONG = (0.0, 0.3, 0.5, 0.7, 1.0)
"""The positions along a limb (0: start, 1: end) whose projections determine the limb's image
window."""

EMPTY_FRACTION = 1.2
"""The maximum area of a window that joins two windows, as a multiple of the sum of their areas. If
the area would be larger, the two windows are not joined."""

LIT_RADIUS_M, LIT_LEVEL = 0.0028, 150.0
"""The radius (m) of a projected mark, and the grey level that the mark adds to the sheet. The mark
has the same area as 10 x 10 projector pixels of 0.5 mm."""

NO_POINTS = np.zeros((0, 3))

SPOTS = 61
"""The number of Gaussian spots whose sum represents a flat marker."""

GOLDEN_ANGLE_RAD = math.pi * (3.0 - math.sqrt(5.0))

GRAIN = 1 << 21
"""The length of the stored sequence of random numbers from which the image noise is taken."""


@dataclass(frozen=True, slots=True)
class Sensor:
    """The properties of the image sensor and the lens.

    Grey levels (0 to 255) are proportional to the light.

    photons_per_level: full-well capacity in photons, divided by 255. The variance of the photon
        noise at level L is L / photons_per_level.
    blur_px: standard deviation of the lens's point spread function in focus.
    aperture_m, focus_m: aperture diameter and focused distance. The image of a point at depth z is
        a disc with the diameter focal_px * aperture_m * |1/z - 1/focus_m|. The disc is drawn as a
        Gaussian with the same standard deviation, a quarter of the diameter.
    exposure: factor by which all light is multiplied. If it is well above 1, the marker saturates.
    noisy_backgrounds: number of precomputed noisy background images per camera.
    """

    marker_level: float = 215.0
    finger_level: float = 85.0
    background_level: float = 32.0
    texture_level: float = 9.0
    read_noise: float = 1.5
    photons_per_level: float = 40.0
    blur_px: float = 0.7
    aperture_m: float = 0.002
    focus_m: float = 0.5
    exposure: float = 1.0
    noisy_backgrounds: int = 8

    def noise(self, levels: Singles) -> Singles:
        """Return the standard deviation of photon and read noise for an array of grey levels."""
        variance = levels * np.float32(1.0 / self.photons_per_level) + np.float32(
            self.read_noise**2
        )
        return np.asarray(np.sqrt(variance), dtype=np.float32)

    def spread_px(self, depth_m: float, focal_px: float) -> float:
        """Return the blur of a point (standard deviation, px) by lens, defocus and pixel area."""
        defocus_px = 0.25 * focal_px * self.aperture_m * abs(1.0 / depth_m - 1.0 / self.focus_m)
        return float(np.sqrt(self.blur_px**2 + defocus_px**2 + 1.0 / 12.0))

    def out_of_focus(self, defocus_px: float, depth_m: float, focal_px: float) -> Sensor:
        """Return a copy of the sensor whose focus is behind points at the depth `depth_m`.

        defocus_px: standard deviation of the blur that the defocus alone causes at this depth.

        Raises ValueError if the aperture is too small for this blur.
        """
        nearer = 4.0 * defocus_px / (focal_px * self.aperture_m)
        focus = 1.0 / depth_m - nearer
        if focus <= 0:
            raise ValueError(
                f"a defocus of {defocus_px:g} px at {depth_m:g} m is impossible even with focus at "
                f"infinity: set aperture_m above {4.0 * defocus_px * depth_m / focal_px:.3g} m"
            )
        return replace(self, focus_m=1.0 / focus)


@dataclass(frozen=True, slots=True)
class CameraView:
    """One camera of the simulated stereo camera, with pixel rays and background images.

    slopes_x, slopes_y (rows, columns): x/z and y/z of the ray through each pixel, in the camera
        frame.
    background: noise-free image of all static objects.
    canvas: buffer in which images are drawn. Between images, it equals the background.
    noisy: copies of the background with noise.
    """

    side: Side
    lens: Lens
    camera_from_world: Floats
    slopes_x: Singles
    slopes_y: Singles
    background: Singles
    canvas: Singles
    noisy: list[Image]

    @property
    def position_m(self) -> Floats:
        """Return the position (3,), m, of the camera's centre in the world frame."""
        return np.asarray(-self.camera_from_world[:3, :3].T @ self.camera_from_world[:3, 3])

    def see(self, point_world: Floats) -> tuple[Floats, float]:
        """Return the pixel (2,) and depth (m) of a world point (3,).

        The pixel is (0, 0) if the depth is not positive.
        """
        x, y, z = (
            self.camera_from_world[:3, :3] @ point_world + self.camera_from_world[:3, 3]
        ).tolist()
        if z <= 0:
            return np.zeros(2), z
        return np.array(project_ray(self.lens, x / z, y / z)), z

    def window(self, pixels: Sequence[tuple[float, float]], reach_px: float) -> Window | None:
        """Return the bounding box of pixels, enlarged by `reach_px` on each side, within the image.

        Returns None if the bounding box is outside the image.
        """
        height, width = self.canvas.shape
        rows = slice(
            max(math.floor(min(y for _, y in pixels) - reach_px), 0),
            min(math.ceil(max(y for _, y in pixels) + reach_px) + 1, height),
        )
        columns = slice(
            max(math.floor(min(x for x, _ in pixels) - reach_px), 0),
            min(math.ceil(max(x for x, _ in pixels) + reach_px) + 1, width),
        )
        return None if rows.start >= rows.stop or columns.start >= columns.stop else (rows, columns)


class TwinCamera:
    """A simulated stereo camera that renders image pairs. The random seed determines the noise."""

    def __init__(
        self,
        camera: StereoCamera,
        *,
        finger_radius_m: float,
        seed: int,
        sensor: Sensor | None = None,
        clutter: Clutter | None = None,
        nail: Nail | None = None,
        skew_s: float = 0.0,
    ) -> None:
        """Render the static background of both cameras.

        camera: true lenses and poses of the stereo camera.
        nail: placement of the marker relative to the fingertip, and direction of the finger. If it
            is None, the marker is a bead at the fingertip.
        skew_s: exposure time of the right image minus the exposure time of the left image.
        """
        self.camera = camera
        self.skew_s = skew_s
        self.nail = Nail() if nail is None else nail
        self.finger_radius_m = finger_radius_m
        self.marker_offset_m = self.nail.marker_offset_m
        self.sensor = Sensor() if sensor is None else sensor
        self.clutter = CLUTTER["none"] if clutter is None else clutter
        self._random = np.random.default_rng(seed)
        self._grain = self._random.standard_normal(GRAIN, dtype=np.float32)
        sheet = None if self.clutter.sheet is None else self._grained(self.clutter.sheet)
        left_from_world = inverse(pose_matrix(camera.world_from_left))
        right_from_world = camera.right_from_left @ left_from_world
        self.eyes = (
            self._eye("left", camera.left, left_from_world, sheet),
            self._eye("right", camera.right, right_from_world, sheet),
        )

    def picture(
        self,
        position: Position,
        *,
        exposure_s: float,
        marker: bool = True,
        time_s: float = 0.0,
        lit_points: Floats = NO_POINTS,
    ) -> tuple[Image, Image]:
        """Render the left and the right image of a finger whose tip moves during the exposure.

        position: function that returns the fingertip position.
        marker: whether the finger wears a marker.
        time_s: simulation time at mid-exposure. It determines the positions of moving clutter.
        lit_points (n, 3): points of the sheet that the projector illuminates, world frame, m.
        """
        left, right = (
            self._exposed(
                eye, self._draw(eye, tips, time_s + instants_s, marker=marker, lit=lit_points)
            )
            for eye, instants_s, tips in self._views(position, exposure_s)
        )
        return left, right

    def levels(
        self, position: Position, *, exposure_s: float, marker: bool = True, time_s: float = 0.0
    ) -> tuple[Singles, Singles]:
        """Render the left and right image (height, width) without noise, saturation and rounding.

        The arguments are the same as for `picture`.
        """
        pictures = []
        for eye, instants_s, tips in self._views(position, exposure_s):
            windows = self._draw(eye, tips, time_s + instants_s, marker=marker)
            pictures.append(eye.canvas.copy())
            _wipe(eye, windows)
        return pictures[0], pictures[1]

    def _views(
        self, position: Position, exposure_s: float
    ) -> Iterator[tuple[CameraView, Floats, Floats]]:
        """Yield each camera with sampling times (n,), s, and fingertip positions (n, 3), m.

        The times are relative to mid-exposure.
        """
        instants_s, tips = self._instants(position, exposure_s)
        left, right = self.eyes
        yield left, instants_s, tips
        if self.skew_s:
            instants_s = instants_s + self.skew_s
            tips = np.stack([position(float(instant)) for instant in instants_s])
        yield right, instants_s, tips

    def _instants(self, position: Position, exposure_s: float) -> tuple[Floats, Floats]:
        """Return the times (n,), s, and tip positions (n, 3), m, at which the finger is drawn.

        The drawn positions add up to the motion blur. The times are relative to mid-exposure.
        Between successive times, the fingertip moves by at most MOTION_STEP_PX in the image, unless
        this would need more than MAX_MOTION_STEPS times.
        """
        ends = [position(share * exposure_s) for share in (-0.5, 0.5)]
        travel_px = 0.0
        for eye in self.eyes:
            (first, first_depth), (last, last_depth) = (eye.see(end) for end in ends)
            if min(first_depth, last_depth) > MIN_DEPTH_M:
                travel_px = max(travel_px, float(np.linalg.norm(last - first)))
        steps = max(1, math.ceil(min(travel_px / MOTION_STEP_PX, MAX_MOTION_STEPS)))
        instants_s = exposure_s * ((np.arange(steps) + 0.5) / steps - 0.5)
        return instants_s, np.stack([position(float(instant)) for instant in instants_s])

    def _exposed(self, eye: CameraView, windows: list[Window]) -> Image:
        """Return the camera image, and reset the canvas.

        The image is a noisy background with the drawn rectangles (`windows`) of the canvas.
        """
        image = eye.noisy[int(self._random.integers(len(eye.noisy)))].copy()
        for window in disjoint(windows):
            image[window] = self._read_out(eye.canvas[window])
        _wipe(eye, windows)
        return image

    def _read_out(self, levels: Singles) -> Image:
        start = int(self._random.integers(GRAIN - levels.size))
        noise = self._grain[start : start + levels.size].reshape(levels.shape)
        return quantize(levels + self.sensor.noise(levels) * noise)

    def _draw(
        self,
        eye: CameraView,
        tips: Floats,
        times_s: Floats,
        *,
        marker: bool,
        lit: Floats = NO_POINTS,
    ) -> list[Window]:
        """Draw the finger and all moving objects on the camera's canvas; return the drawn windows.

        tips (n, 3): fingertip positions during the exposure, m.
        times_s (n,): times of these positions.
        """
        clutter, sensor = self.clutter, self.sensor
        time_s, tip = float(times_s.mean()), tips.mean(axis=0)
        motion = tips[-1] - tips[0]
        windows = [
            self._disc(eye, point[None], LIT_RADIUS_M, LIT_LEVEL, adds=True) for point in lit
        ]
        for limb in clutter.limbs:
            ends = np.stack([limb.start.at(time_s), limb.end.at(time_s)])
            if limb.carried:
                ends += tip + self.nail.knuckle_shift_m
            radii_m = (limb.start_radius_m, limb.end_radius_m)
            moved = motion if limb.carried else np.zeros(3)
            windows.append(self._limb(eye, ends, radii_m, limb.level, moved, lit=True))
        start = tip + self.nail.find_axis_shift_m(self.finger_radius_m)
        ends = np.stack([start, start + FINGER_LENGTH_M * self.nail.direction])
        width_m = self.nail.find_half_width_m(start - eye.position_m, self.finger_radius_m)
        radii_m = (width_m, 1.2 * width_m)
        windows.append(self._limb(eye, ends, radii_m, sensor.finger_level, motion, lit=True))
        if marker:
            at = tips + self.marker_offset_m
            if self.nail.marker_normal is None:
                windows.append(self._disc(eye, at, MARKER_RADIUS_M, sensor.marker_level))
            else:
                windows.append(self._flat_disc(eye, at, self.nail.marker_normal))
        for thing in _spots(clutter, eye.side):
            if not _is_static(thing):
                places = np.stack([thing.path.at(float(instant)) for instant in times_s])
                windows.append(self._spot(eye, thing, places + tips if thing.carried else places))
        for occluder in clutter.occluders:
            if occluder.views in ("both", eye.side):
                ends = np.stack([occluder.start.at(time_s), occluder.end.at(time_s)])
                if occluder.carried:
                    ends += tip
                radii_m = (occluder.radius_m, occluder.radius_m)
                moved = motion if occluder.carried else np.zeros(3)
                windows.append(self._limb(eye, ends, radii_m, occluder.level, moved, lit=False))
        return [window for window in windows if window is not None]

    def _spot(
        self, eye: CameraView, thing: SecondMarker | Highlight, places: Floats
    ) -> Window | None:
        adds = isinstance(thing, Highlight)
        return self._disc(eye, places, thing.radius_m, thing.level, adds=adds)

    def _limb(
        self,
        eye: CameraView,
        ends: Floats,
        radii_m: tuple[float, float],
        level: float,
        motion: Floats,
        *,
        lit: bool,
    ) -> Window | None:
        """Draw a tapered capsule between two world points (2, 3), and return the drawn window.

        Returns None if the capsule is not visible.

        lit: whether the lamp illuminates the capsule from the side; otherwise its grey level is
            constant.
        motion (3,): displacement of the limb during the exposure, m. It increases the blur of the
            edges.

        The profile of the edges is a cubic polynomial within 2 % of the normal distribution
        function. It is not valid for a limb that is thinner than its blurred edges.
        """
        (x0, y0, z0), (x1, y1, z1) = apply(eye.camera_from_world, ends).tolist()
        if min(z0, z1) <= MIN_DEPTH_M:
            return None
        u0, v0, u1, v1 = x0 / z0, y0 / z0, x1 / z1, y1 / z1
        width0, width1 = radii_m[0] / z0, radii_m[1] / z1
        scale = pixels_per_slope(eye.lens, u0, v0)
        travel_px = scale / z0 * math.hypot(*motion.tolist())
        spread_px = math.hypot(self.sensor.spread_px(z0, eye.lens.fx_px), travel_px / math.sqrt(12))
        # Lens distortion bends straight lines, so the bounding box of the ends does not suffice.
        pixels = [
            project_ray(eye.lens, u0 + share * (u1 - u0), v0 + share * (v1 - v0)) for share in ALONG
        ]
        window = eye.window(pixels, scale * max(width0, width1) + 3.0 * spread_px)
        if window is None:
            return None
        single = np.float32
        length = max(math.hypot(u1 - u0, v1 - v0), 1e-6)
        along_x, along_y = single((u1 - u0) / length), single((v1 - v0) / length)
        dx, dy = eye.slopes_x[window] - single(u0), eye.slopes_y[window] - single(v0)
        along = dx * along_x + dy * along_y
        across = dx * along_y - dy * along_x
        within = np.minimum(np.maximum(along, single(0.0)), single(length))
        off = cv2.magnitude(across, along - within)
        width = within * single((width1 - width0) / length) + single(width0)
        # The edge rises from 0 to 1 by a cubic over +-2.2 standard deviations.
        edge = (width - off) * single(scale / (4.4 * spread_px)) + single(0.5)
        edge = np.minimum(np.maximum(edge, single(0.0)), single(1.0))
        cover = edge * edge * (single(3.0) - single(2.0) * edge)
        light: Singles | np.float32 = single(level * self.sensor.exposure)
        if lit:
            lamp = (eye.camera_from_world[:2, :3] @ LIGHT).tolist()
            side = SIDE_LIGHT * (lamp[0] * float(along_y) - lamp[1] * float(along_x))
            aside = np.minimum(np.maximum(across / width, single(-1.0)), single(1.0))
            light = light + light * aside * (single(side) - single(SHADE) * aside)
        canvas = eye.canvas[window]
        canvas += cover * (light - canvas)
        return window

    def _disc(
        self, eye: CameraView, places: Floats, radius_m: float, level: float, *, adds: bool = False
    ) -> Window | None:
        """Draw a luminous ball that passes through world points (n, 3) during the exposure.

        Returns the drawn window, or None if the ball is not visible.

        adds: whether the light of the ball is added to the background; otherwise the ball hides the
            background.
        """
        in_camera = apply(eye.camera_from_world, places)
        if in_camera[:, 2].min() <= MIN_DEPTH_M:
            return None
        x, y, z = in_camera.mean(axis=0).tolist()
        spread_px = self.sensor.spread_px(z, eye.lens.fx_px)
        reach_px = pixels_per_slope(eye.lens, x / z, y / z) * radius_m / z + 4.0 * spread_px
        pixels = [project_ray(eye.lens, x / z, y / z) for x, y, z in in_camera.tolist()]
        window = eye.window(pixels, reach_px)
        if window is None:
            return None
        cover = rasterize_ball(eye, in_camera, radius_m, spread_px, window)
        canvas = eye.canvas[window]
        light = np.float32(level * self.sensor.exposure)
        canvas += cover * (light if adds else light - canvas)
        return window

    def _flat_disc(self, eye: CameraView, places: Floats, normal: Floats) -> Window | None:
        """Draw a flat marker that moves during the exposure.

        places (n, 3): world positions of its centre during the exposure.
        normal (3,): normal of the marker.

        Returns the drawn window, or None if the marker is not visible or is seen from behind.

        The marker is drawn as a sum of Gaussian spots. If it is larger than the blur, its total
        light differs by at most 1 % from a uniform disc.
        """
        in_camera = apply(eye.camera_from_world, places)
        centre = in_camera.mean(axis=0)
        towards = float(-(eye.camera_from_world[:3, :3] @ normal) @ centre)
        x, y, z = centre.tolist()
        if in_camera[:, 2].min() <= MIN_DEPTH_M or towards <= 0.0:
            return None
        per_slope = pixels_per_slope(eye.lens, x / z, y / z)
        area_px = math.pi * (MARKER_RADIUS_M * per_slope) ** 2 * towards / z**3 / SPOTS
        spread_px = math.hypot(
            self.sensor.spread_px(z, eye.lens.fx_px), math.sqrt(area_px / (4.0 * math.pi))
        )
        spots = _disc_points(normal) * MARKER_RADIUS_M
        local = apply(eye.camera_from_world, (places[:, None] + spots).reshape(-1, 3))
        pixels = pixels_of(eye.lens, local[:, :2] / local[:, 2:])
        corners = [pixels.min(axis=0).tolist(), pixels.max(axis=0).tolist()]
        window = eye.window([(u, v) for u, v in corners], 4.0 * spread_px)
        if window is None:
            return None
        rows, columns = (np.arange(part.start, part.stop)[:, None] for part in window)
        across = np.exp(-0.5 * ((columns - pixels[:, 0]) / spread_px) ** 2)
        down = np.exp(-0.5 * ((rows - pixels[:, 1]) / spread_px) ** 2)
        weight = area_px / (2.0 * math.pi * spread_px**2 * len(places))
        cover = np.minimum(weight * (down @ across.T), 1.0).astype(np.float32)
        canvas = eye.canvas[window]
        canvas += cover * (np.float32(self.sensor.marker_level * self.sensor.exposure) - canvas)
        return window

    def _eye(
        self, side: Side, lens: Lens, camera_from_world: Floats, sheet: Singles | None
    ) -> CameraView:
        height, width = self.camera.height_px, self.camera.width_px
        slopes = _slopes(lens, width, height)
        canvas = self._make_background(height, width)
        if self.clutter.sheet is not None and sheet is not None:
            self._draw_sheet(self.clutter.sheet, sheet, canvas, slopes, camera_from_world)
        canvas *= np.float32(self.sensor.exposure)
        eye = CameraView(
            side=side,
            lens=lens,
            camera_from_world=camera_from_world,
            slopes_x=np.ascontiguousarray(slopes[..., 0], dtype=np.float32),
            slopes_y=np.ascontiguousarray(slopes[..., 1], dtype=np.float32),
            background=canvas.copy(),
            canvas=canvas,
            noisy=[],
        )
        for thing in _spots(self.clutter, side):
            if _is_static(thing):
                self._spot(eye, thing, thing.path.at(0.0)[None])
        eye.background[:] = canvas
        for _ in range(self.sensor.noisy_backgrounds):
            eye.noisy.append(self._read_out(canvas))
        return eye

    def _make_background(self, height: int, width: int) -> Singles:
        """Return the image (height, width) of a dark room: smooth noise darker than the marker."""
        texture = np.zeros((height, width), dtype=np.float32)
        for cells, share in ((24, 0.7), (96, 0.3)):
            coarse = self._random.standard_normal((cells, cells), dtype=np.float32)
            texture += share * cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
        level = self.sensor.background_level + self.sensor.texture_level * texture
        return np.asarray(np.clip(level, 2.0, 0.4 * self.sensor.marker_level), dtype=np.float32)

    def _grained(self, sheet: Sheet) -> Singles:
        """Return the grey levels (rows, columns) of the sheet's texture, two samples per grain.

        The texture is the sum of fine and coarse noise. The left side is brighter.
        """
        size = [
            2 + int(np.ceil(4.0 * half_m / sheet.grain_m))
            for half_m in (sheet.half_height_m, sheet.half_width_m)
        ]
        fine = cv2.GaussianBlur(self._random.standard_normal(size, np.float32), (0, 0), 1.0)
        blotches = self._random.standard_normal((6, 6), dtype=np.float32)
        wide = cv2.resize(blotches, (size[1], size[0]), interpolation=cv2.INTER_CUBIC)
        grain = 0.8 * fine / fine.std() + 0.6 * wide / wide.std()
        lit = np.linspace(1.08, 0.92, size[1], dtype=np.float32)
        return np.asarray((sheet.level + sheet.contrast * grain) * lit, dtype=np.float32)

    def _draw_sheet(
        self, sheet: Sheet, grain: Singles, canvas: Singles, slopes: Floats, pose: Floats
    ) -> None:
        """Draw the sheet in the world plane z = 0 on the canvas.

        grain: grey levels of the sheet's texture.
        slopes (height, width, 2): x/z and y/z of the pixels' rays.
        pose (4, 4): camera_from_world.
        """
        plane_from_ray = np.linalg.inv(pose[:3, [0, 1, 3]])
        on_plane = slopes @ plane_from_ray[:, :2].T + plane_from_ray[:, 2]
        before = on_plane[..., 2] > 0
        place = on_plane[..., :2] / np.where(before, on_plane[..., 2], 1.0)[..., None]
        half = np.array([sheet.half_width_m, sheet.half_height_m])
        cells = ((place + half) * (2.0 / sheet.grain_m)).astype(np.float32)
        level = cv2.remap(
            grain, cells[..., 0], cells[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        px_m = np.hypot(*np.gradient(place[..., 0])) + np.hypot(*np.gradient(place[..., 1]))
        inside_m = (half - np.abs(place)).min(axis=-1)
        cover = before * np.clip(0.5 + inside_m / px_m, 0.0, 1.0)
        canvas += (cover * (level - canvas)).astype(np.float32)


def _disc_points(normal: Floats) -> Floats:
    """Return points (SPOTS, 3) that evenly fill the unit disc perpendicular to `normal` (3,)."""
    number = np.arange(SPOTS) + 0.5
    radius, angle = np.sqrt(number / SPOTS), GOLDEN_ANGLE_RAD * number
    aside = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    aside /= np.linalg.norm(aside)
    other = np.cross(normal, aside)
    return np.asarray(
        (radius * np.cos(angle))[:, None] * aside + (radius * np.sin(angle))[:, None] * other
    )


@lru_cache(maxsize=4)
def _slopes(lens: Lens, width: int, height: int) -> Floats:
    """Return the slopes x/z and y/z (height, width, 2) of the rays through all pixels."""
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
    slopes = slopes_of(lens, pixels.astype(np.float64))
    slopes.setflags(write=False)
    return slopes


def rasterize_ball(
    eye: CameraView, centres: Floats, radius_m: float, spread_px: float, window: Window
) -> Singles:
    """Return the fraction (rows, columns) of each pixel's light that comes from a ball.

    centres (n, 3): positions of the ball during the exposure, camera frame, m. The result is the
        mean over these positions.
    spread_px: standard deviation s of the blur.

    A ray passes a centre at the distance d = |ray x centre| / |ray|. For a disc of radius r, the
    fraction is the non-central chi-square distribution function at (r/s)^2, with two degrees of
    freedom and the non-centrality (d/s)^2.
    """
    single = np.float32
    u, v = eye.slopes_x[window], eye.slopes_y[window]
    ray_sq = u * u + v * v + single(1.0)
    cover = np.zeros_like(u)
    for a, b, c in centres.tolist():
        x, y = a / c, b / c
        # Pixels per metre perpendicular to the ray; it converts the blur from pixels to metres.
        scale = pixels_per_slope(eye.lens, x, y) * (1.0 + x * x + y * y) ** 0.25 / c
        spread_sq = (spread_px / scale) ** 2
        du, dv = u - single(x), v - single(y)
        turn = du * single(y) - dv * single(x)
        distance_sq = (du * du + dv * dv + turn * turn) * single(c * c / spread_sq) / ray_sq
        cover += scipy.special.chndtr(single(radius_m**2 / spread_sq), single(2.0), distance_sq)
    return np.asarray(cover / single(len(centres)), dtype=np.float32)


def quantize(levels: Singles) -> Image:
    """Round grey levels to integers, and limit them to the range 0 to 255."""
    return np.minimum(np.maximum(np.rint(levels), 0.0), 255.0).astype(np.uint8)


def _spots(clutter: Clutter, side: Side) -> list[SecondMarker | Highlight]:
    spots: list[SecondMarker | Highlight] = [*clutter.markers, *clutter.highlights]
    return [spot for spot in spots if spot.views in ("both", side)]


def _is_static(thing: SecondMarker | Highlight) -> bool:
    return isinstance(thing.path, FixedPoint) and not thing.carried


def _wipe(eye: CameraView, windows: list[Window]) -> None:
    for window in windows:
        eye.canvas[window] = eye.background[window]


def disjoint(windows: list[Window]) -> list[Window]:
    """Return windows that do not overlap and cover all pixels of the given windows.

    Two overlapping windows are joined. If the joined window would be too large (see
    EMPTY_FRACTION), the overlap is removed from one of the two windows.
    """
    apart: list[Window] = []
    pending = list(windows)
    while pending:
        one = pending.pop()
        other = next((each for each in apart if _overlap(one, each)), None)
        if other is None:
            apart.append(one)
            continue
        both = (
            slice(min(one[0].start, other[0].start), max(one[0].stop, other[0].stop)),
            slice(min(one[1].start, other[1].start), max(one[1].stop, other[1].stop)),
        )
        if _area(both) <= EMPTY_FRACTION * (_area(one) + _area(other)):
            apart.remove(other)
            pending.append(both)
        else:
            pending.extend(_beyond(one, other))
    return apart


def _area(window: Window) -> int:
    rows, columns = window
    return int(rows.stop - rows.start) * int(columns.stop - columns.start)


def _overlap(a: Window, b: Window) -> bool:
    return all(
        first.start < second.stop and second.start < first.stop
        for first, second in zip(a, b, strict=True)
    )


def _beyond(one: Window, other: Window) -> list[Window]:
    """Return the parts (at most four) of the window `one` that are outside the window `other`."""
    (rows, columns), (cut_rows, cut_columns) = one, other
    between = slice(max(rows.start, cut_rows.start), min(rows.stop, cut_rows.stop))
    parts = [
        (slice(rows.start, between.start), columns),
        (slice(between.stop, rows.stop), columns),
        (between, slice(columns.start, max(columns.start, cut_columns.start))),
        (between, slice(min(columns.stop, cut_columns.stop), columns.stop)),
    ]
    return [part for part in parts if _area(part) > 0]
