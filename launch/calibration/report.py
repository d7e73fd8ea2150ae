"""Write a report of a stereo calibration as an HTML page.

The report shows the corner residuals, the quality of each image pair, the coverage of the images
and the uncertainty. The page contains its images, which are also written as PNG files.
"""

from __future__ import annotations

import base64
import html
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from flexsheet.launch.calibration.bundle import PARAMETERS, pose_transform
from flexsheet.launch.calibration.check import StereoRig
from flexsheet.launch.calibration.corners import board_points, describe
from flexsheet.launch.calibration.stereo import CalibrationResult
from flexsheet.messages.files import write_file
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models import rigid

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


DOTS_PER_INCH = 110
ARROW_PX = 40.0
"""The length (px of the camera image) of the arrow for the 95 % quantile of the residuals."""

STYLE = """
body { font: 15px/1.45 sans-serif; max-width: 1100px; margin: 2em auto; padding: 0 1em; }
table { border-collapse: collapse; } td, th { padding: 0.15em 0.8em; text-align: right; }
td:first-child, th:first-child { text-align: left; } tr:nth-child(even) { background: #f2f2f2; }
img { max-width: 100%; } figcaption { color: #444; }
"""


def compute_epipolar_distances(calibrated: CalibrationResult) -> tuple[Floats, Floats]:
    """Compute the distance between each corner in the right image and its epipolar line.

    Return the pixels (n, 2) of the n corners in the right image, and the signed distances (n,), in
    px. Only corners that both images show are included. The distances are measured in undistorted
    coordinates of the right camera.
    """
    rig = StereoRig.from_fit(calibrated.fit.rig)
    rotation, position = rig.right_from_left[:3, :3], rig.right_from_left[:3, 3]
    essential = rigid.skew(position) @ rotation
    points, distances = [], []
    for pair in calibrated.pairs.values():
        _, left, right = pair.common()
        rays = []
        for pixels, matrix, distortion in zip(
            (left, right), rig.matrices, rig.distortions, strict=True
        ):
            slopes = cv2.undistortPoints(pixels[:, None], matrix, distortion)[:, 0]
            rays.append(np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1))
        lines = rays[0] @ essential.T
        error = (rays[1] * lines).sum(axis=1) / np.linalg.norm(lines[:, :2], axis=1)
        distances.append(rig.matrices[1][1, 1] * error)
        points.append(right)
    return np.concatenate(points), np.concatenate(distances)


def _draw_residuals(calibrated: CalibrationResult) -> Figure:
    figure, axes = _figure(1, 2, (13.0, 5.0))
    lengths = np.concatenate(
        [np.linalg.norm(view, axis=1) for views in calibrated.fit.residuals for view in views]
    )
    longest = float(np.percentile(lengths, 95.0))
    for side, (axis, name) in enumerate(zip(axes, ("left", "right"), strict=True)):
        views = [(pair.left, pair.right)[side] for pair in calibrated.pairs.values()]
        points = np.concatenate([view.pixels for view in views])
        shifts = np.concatenate([residual[side] for residual in calibrated.fit.residuals])
        numbers = np.concatenate([[i] * len(view.ids) for i, view in enumerate(views)])
        arrows = axis.quiver(
            *points.T,
            *shifts.T,
            numbers,
            cmap="turbo",
            angles="xy",
            scale_units="xy",
            scale=longest / ARROW_PX,
            width=0.0015,
        )
        axis.quiverkey(arrows, 0.85, 1.03, longest, f"{longest:.2g} px", labelpos="E")
        _format_image_axis(axis, calibrated.size, f"{name}: detected - projected, by pair")
    return figure


def _draw_pairs(calibrated: CalibrationResult) -> Figure:
    figure, (axis,) = _figure(1, 1, (13.0, 3.6))
    pairs = calibrated.calibration.pairs
    x = np.arange(len(pairs))
    for shift, side, colour in ((-0.2, "left", "tab:blue"), (0.2, "right", "tab:orange")):
        heights = [getattr(pair, f"{side}_rms_px") or 0.0 for pair in pairs]
        axis.bar(x + shift, heights, 0.4, label=side, color=colour)
    axis.axhline(calibrated.calibration.reprojection_rms_px, color="black", lw=0.8, label="all")
    for i, pair in enumerate(pairs):
        if not pair.used:
            axis.axvspan(i - 0.5, i + 0.5, color="tab:red", alpha=0.2)
    axis.set_xticks(x, [pair.left for pair in pairs], rotation=90, fontsize=7)
    axis.set_ylabel("rms, px")
    axis.legend()
    return figure


def _draw_coverage(calibrated: CalibrationResult) -> Figure:
    figure, axes = _figure(1, 3, (15.0, 4.2))
    for axis, side in zip(axes[:2], ("left", "right"), strict=True):
        for pair in calibrated.pairs.values():
            axis.plot(*getattr(pair, side).pixels.T, ".", ms=2.5)
        _format_image_axis(axis, calibrated.size, f"corners in the {side} image")
    middle = board_points(calibrated.calibration.board).mean(axis=0)
    tilts, depths = [], []
    for pose in calibrated.fit.poses:
        transform = pose_transform(pose)
        normal = transform[:3, 2] * np.sign(transform[2, 2])
        tilts.append(np.degrees(np.arctan2(normal[:2], normal[2])))
        depths.append((transform[:3, :3] @ middle + transform[:3, 3])[2])
    about_y, about_x = np.transpose(tilts)
    points = axes[2].scatter(about_y, about_x, c=np.array(depths) * 1e3, cmap="viridis")
    figure.colorbar(points, ax=axes[2], label="distance, mm")
    axes[2].set(xlabel="tilt about y, degrees", ylabel="tilt about x, degrees", title="poses")
    axes[2].grid(alpha=0.3)
    return figure


def _draw_epipolar(calibrated: CalibrationResult) -> Figure:
    figure, axes = _figure(1, 2, (13.0, 4.6))
    pixels, error = compute_epipolar_distances(calibrated)
    largest = float(np.percentile(np.abs(error), 98.0))
    points = axes[0].scatter(
        pixels[:, 0], pixels[:, 1], c=error, s=7, cmap="coolwarm", vmin=-largest, vmax=largest
    )
    figure.colorbar(points, ax=axes[0], label="px")
    _format_image_axis(axes[0], calibrated.size, "right: distance from the epipolar line")
    axes[1].hist(error, bins=60, range=(-2 * largest, 2 * largest))
    rms = float(np.sqrt(np.mean(error**2)))
    axes[1].set(xlabel="distance, px", ylabel="corners", title=f"rms {rms:.3f} px")
    return figure


def _figure(rows: int, columns: int, size_in: tuple[float, float]) -> tuple[Figure, list[Axes]]:
    from matplotlib.figure import Figure  # slow import

    figure = Figure(figsize=size_in, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    return figure, list(axes.ravel())


def _format_image_axis(axis: Axes, size: tuple[int, int], title: str) -> None:
    axis.set(xlim=(0, size[0]), ylim=(size[1], 0), title=title)
    axis.set_aspect("equal")


def list_parameters(calibrated: CalibrationResult) -> list[tuple[str, float, float]]:
    """Return (name, value, standard deviation) of each of the 22 parameters of the stereo rig."""
    uncertainty = calibrated.calibration.uncertainty
    assert uncertainty is not None
    deviations = np.sqrt(np.diag(uncertainty.covariance))
    return [
        (name, float(value), float(deviation))
        for name, value, deviation in zip(PARAMETERS, calibrated.fit.rig, deviations, strict=True)
    ]


def write_report(calibrated: CalibrationResult, folder: Path) -> Path:
    """Write the report `index.html` and its images to a folder, and return the path of the page.

    The folder is created if it does not exist.
    """
    folder.mkdir(parents=True, exist_ok=True)
    calibration = calibrated.calibration
    board, uncertainty = calibration.board, calibration.uncertainty
    assert uncertainty is not None
    drawings = {
        "residuals": (_draw_residuals, "Residuals. Neighbouring arrows in one direction indicate a "
                      "wrong lens model or a board that is not flat."),
        "pairs": (_draw_pairs, "Rms residual per pair; red: excluded."),
        "coverage": (_draw_coverage, "Board positions. The lens is extrapolated in blank areas."),
        "epipolar": (_draw_epipolar, "Epipolar residuals: corner noise, independent of depth."),
    }  # fmt: skip
    figures = []
    for name, (draw, text) in drawings.items():
        image = BytesIO()
        draw(calibrated).savefig(image, format="png", dpi=DOTS_PER_INCH)
        write_file(folder / f"{name}.png", image.getvalue())
        coded = base64.b64encode(image.getvalue()).decode()
        figures.append(
            f'<figure><img alt="{name}" src="data:image/png;base64,{coded}">'
            f"<figcaption>{text}</figcaption></figure>"
        )
    used = sum(pair.used for pair in calibration.pairs)
    facts = [
        ("device", calibration.device),
        ("date", calibration.date),
        ("board", f"{describe(board)}, squares of {1e3 * board.square_m:g} mm"),
        ("images", f"{calibration.width_px}x{calibration.height_px} px"),
        ("pairs", f"{used} of {len(calibration.pairs)} used"),
        ("reprojection", f"{calibration.reprojection_rms_px:.3f} px rms"),
        ("corner noise", f"{uncertainty.corner_sigma_px:.3f} px per coordinate"),
        (
            "uncertainty of a fingertip",
            f"{1e3 * uncertainty.depth_std_m:.3f} mm depth, "
            f"{1e3 * uncertainty.lateral_std_m:.3f} mm lateral (one standard deviation) at "
            f"{1e3 * uncertainty.working_distance_m:.0f} mm",
        ),
        (
            "jackknife scatter over fit uncertainty",
            f"{uncertainty.jackknife_ratio:.2f}"
            + ("; the uncertainty is scaled by it" if uncertainty.jackknife_ratio > 1 else ""),
        ),
        ("software", f"flexsheet {calibration.code_version}, OpenCV {calibration.opencv_version}"),
    ]
    left_out = [
        f"<li>{html.escape(pair.left)}: {html.escape(pair.reason)}</li>"
        for pair in calibration.pairs
        if not pair.used
    ]
    page = "\n".join(
        [
            '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">',
            f"<title>Calibration of {html.escape(calibration.device)}</title>",
            f"<style>{STYLE}</style></head><body>",
            f"<h1>Calibration of {html.escape(calibration.device)}</h1><table>",
            *(f"<tr><td>{name}</td><td>{html.escape(str(text))}</td></tr>" for name, text in facts),
            "</table>",
            *(["<h2>Excluded pairs</h2><ul>", *left_out, "</ul>"] if left_out else []),
            *figures,
            "<h2>Parameters of the rig</h2><table><tr><th>name</th><th>value</th><th>standard "
            "deviation</th></tr>",
            *(
                f"<tr><td>{name}</td><td>{value:.6g}</td><td>{deviation:.2g}</td></tr>"
                for name, value, deviation in list_parameters(calibrated)
            ),
            "</table></body></html>\n",
        ]
    )
    path = folder / "index.html"
    write_file(path, page)
    return path
