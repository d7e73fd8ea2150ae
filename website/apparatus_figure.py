"""Draw the labelled figure of the apparatus as SVG.

Positions are in the world frame, m, and are not to scale along z.  The projection is orthographic.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, pi, radians, sin

Point = tuple[float, float, float]
Pixel = tuple[float, float]

WIDTH_PX, HEIGHT_PX = 800, 470
ORIGIN_PX: Pixel = (385.0, 235.0)
SCALE_PX_PER_M = 470.0
AZIMUTH_RAD, ELEVATION_RAD = radians(18.0), radians(28.0)

TITLE = (
    "Apparatus: two arms hold a rubber sheet between the user's finger and the virtual object; "
    "a stereo camera sees the finger, a projector lights the sheet from behind"
)

STYLE = """
  text { font: 14px system-ui, sans-serif; fill: #1f2328 }
  .lead { stroke: #57606a; stroke-width: 1; fill: none }
  .arm { fill: none; stroke: #8794dd; stroke-width: 17; stroke-linecap: round;
    stroke-linejoin: round }
  .base { fill: #4f5fb0 }
  .clamp { fill: none; stroke: #2b356e; stroke-width: 9 }
  .sheet { fill: #9aa4b2; fill-opacity: 0.55; stroke: #57606a }
  .object { fill: #f2b799; fill-opacity: 0.9; stroke: #a85f3c; stroke-dasharray: 5 3 }
  .light { fill: #ffd54d; fill-opacity: 0.28; stroke: #b58900; stroke-dasharray: 3 4 }
  .sight { fill: none; stroke: #2f7d4f; stroke-width: 1.3; stroke-dasharray: 6 4 }
  .device { fill: #f6f8fa; stroke: #57606a; stroke-width: 1.3 }
  .glass { fill: #57606a }
  .finger { fill: none; stroke: #d99a78; stroke-width: 15; stroke-linecap: round }
  .marker { fill: #18a558 }
  @media (prefers-color-scheme: dark) {
    text { fill: #e6edf3 }
    .lead { stroke: #a5adba }
    .clamp { stroke: #c5ccf5 }
    .device { fill: #22262e; stroke: #a5adba }
    .glass { fill: #a5adba }
  }
"""

EDGE_M, HALF_HEIGHT_M = 0.16, 0.15
"""The distance of the sheet's clamped edges from its centre, and half of their length, m."""
EYE: Point = (0.0, 0.0, 0.72)
CAMERA: Point = (0.0, 0.56, 0.46)
PROJECTOR: Point = (0.0, -0.20, -1.1)
FINGERTIP: Point = (0.02, 0.03, 0.012)
KNUCKLE: Point = (0.14, -0.05, 0.28)
RADIUS_M, HALF_LENGTH_M = 0.06, 0.10
"""Radius and half of the length of the virtual cylinder, m."""


def project(point: Point) -> Pixel:
    """Return the position of a world point in the figure, px."""
    x, y, z = point
    right = x * cos(AZIMUTH_RAD) - z * sin(AZIMUTH_RAD)
    depth = x * sin(AZIMUTH_RAD) + z * cos(AZIMUTH_RAD)
    up = y * cos(ELEVATION_RAD) - depth * sin(ELEVATION_RAD)
    return ORIGIN_PX[0] + SCALE_PX_PER_M * right, ORIGIN_PX[1] - SCALE_PX_PER_M * up


def svg() -> str:
    """Return the figure as an SVG file, for light and dark colour schemes."""
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH_PX} {HEIGHT_PX}" '
        f'width="{WIDTH_PX}" height="{HEIGHT_PX}" role="img" aria-label="{TITLE}">',
        f"<style>{STYLE}</style>",
        *_projector(),
        *_arm(-1.0),
        *_cylinder(),
        _shape("sheet", _sheet_corners()),
        *_arm(1.0),
        *(_clamp(side) for side in (-1.0, 1.0)),
        _line("sight", (EYE, FINGERTIP)),
        *(_line("sight", (lens, FINGERTIP)) for lens in _lenses()),
        _line("finger", (KNUCKLE, FINGERTIP)),
        _disc("marker", FINGERTIP, 5.0),
        *_camera(),
        *_eye(),
        *_labels(),
    ]
    return "\n".join([*lines, "</svg>", ""])


def _sheet_corners() -> tuple[Point, ...]:
    return tuple(
        (side * EDGE_M, end * HALF_HEIGHT_M, 0.0)
        for side, end in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    )


def _arm(side: float) -> list[str]:
    joints: Sequence[Point] = (
        (side * 0.52, -0.36, 0.0),
        (side * 0.52, -0.14, 0.0),
        (side * 0.46, 0.14, 0.0),
        (side * 0.29, 0.02, 0.0),
        (side * EDGE_M, 0.0, 0.0),
    )
    x, y = project(joints[0])
    return [
        f'<rect class="base" x="{x - 26:.1f}" y="{y - 6:.1f}" width="52" height="22" rx="4"/>',
        _line("arm", joints),
        *(_disc("base", joint, 6.0) for joint in joints[1:4]),
    ]


def _clamp(side: float) -> str:
    return _line("clamp", [(side * EDGE_M, end * HALF_HEIGHT_M, 0.0) for end in (-1.0, 1.0)])


def _cylinder() -> list[str]:
    """Draw the cylinder, whose axis is along x and whose side touches the sheet from behind."""
    ring = [
        (RADIUS_M * sin(2.0 * pi * step / 36), -RADIUS_M + RADIUS_M * cos(2.0 * pi * step / 36))
        for step in range(36)
    ]
    ends = [[project((end * HALF_LENGTH_M, y, z)) for y, z in ring] for end in (-1.0, 1.0)]
    hull = _convex_hull([pixel for end in ends for pixel in end])
    return [_polygon("object", hull), _polygon("object", ends[1])]


def _convex_hull(pixels: Sequence[Pixel]) -> list[Pixel]:
    """Return the convex hull of points in order (monotone chain)."""

    def half(points: Sequence[Pixel]) -> list[Pixel]:
        chain: list[Pixel] = []
        for x, y in points:
            while len(chain) > 1 and (
                (chain[-1][0] - chain[-2][0]) * (y - chain[-2][1])
                <= (chain[-1][1] - chain[-2][1]) * (x - chain[-2][0])
            ):
                chain.pop()
            chain.append((x, y))
        return chain[:-1]

    ordered = sorted(pixels)
    return half(ordered) + half(ordered[::-1])


def _projector() -> list[str]:
    apex = project(PROJECTOR)
    beam = _convex_hull([apex, *(project(corner) for corner in _sheet_corners())])
    return [_polygon("light", beam), _device(PROJECTOR, 74, 40), _disc("glass", PROJECTOR, 8.0)]


def _lenses() -> tuple[Point, Point]:
    x, y, z = CAMERA
    return (x - 0.05, y, z), (x + 0.05, y, z)


def _camera() -> list[str]:
    return [_device(CAMERA, 74, 26), *(_disc("glass", lens, 6.0) for lens in _lenses())]


def _eye() -> list[str]:
    x, y = project(EYE)
    outline = f"M{x - 24:.1f} {y:.1f}Q{x:.1f} {y - 26:.1f} {x + 24:.1f} {y:.1f}"
    outline += f"Q{x:.1f} {y + 26:.1f} {x - 24:.1f} {y:.1f}z"
    return [f'<path class="device" d="{outline}"/>', _disc("glass", EYE, 8.0)]


def _labels() -> list[str]:
    texts: Sequence[tuple[str, Point, Pixel, str]] = (
        ("robot arm", (-0.46, 0.14, 0.0), (95, 110), "middle"),
        ("robot arm", (0.46, 0.14, 0.0), (640, 145), "middle"),
        ("clamp", (-EDGE_M, -0.12, 0.0), (240, 300), "end"),
        ("rubber sheet", (-0.10, 0.13, 0.0), (265, 110), "end"),
        ("virtual object", (0.05, -0.02, -0.05), (500, 345), "start"),
        ("finger with marker", KNUCKLE, (425, 425), "start"),
        ("stereo camera", CAMERA, (265, 60), "end"),
        ("eye", EYE, (205, 400), "end"),
        ("projector", PROJECTOR, (620, 70), "start"),
    )
    found = []
    for label, target, (x, y), anchor in texts:
        to_x, to_y = project(target)
        found.append(f'<path class="lead" d="M{x} {y}L{to_x:.1f} {to_y:.1f}"/>')
        found.append(f'<text x="{x}" y="{y - 5}" style="text-anchor:{anchor}">{label}</text>')
    return found


def _shape(kind: str, corners: Sequence[Point]) -> str:
    return _polygon(kind, [project(corner) for corner in corners])


def _polygon(kind: str, corners: Sequence[Pixel]) -> str:
    return f'<polygon class="{kind}" points="{_format(corners)}"/>'


def _line(kind: str, points: Sequence[Point]) -> str:
    return f'<polyline class="{kind}" points="{_format([project(one) for one in points])}"/>'


def _disc(kind: str, centre: Point, radius_px: float) -> str:
    x, y = project(centre)
    return f'<circle class="{kind}" cx="{x:.1f}" cy="{y:.1f}" r="{radius_px:g}"/>'


def _device(centre: Point, width_px: float, height_px: float) -> str:
    x, y = project(centre)
    return (
        f'<rect class="device" x="{x - width_px / 2:.1f}" y="{y - height_px / 2:.1f}" '
        f'width="{width_px:g}" height="{height_px:g}" rx="5"/>'
    )


def _format(pixels: Sequence[Pixel]) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in pixels)
