"""Read measured pushes of a finger into the sheet from a bag with the topic `force`.

A push is a measured force, together with the depth and the position of the finger in the sheet.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flexsheet.launch.calibration.sheet_fit import MeasuredPush, SheetModelFitError
from flexsheet.launch.calibration.simulated_sheet import flat_axes
from flexsheet.launch.experiments.stroke import SampledMotion, make_motion
from flexsheet.messages.bag import BagReader
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import ArmState, Fingertip, Force
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import pose_matrix

QUIET_S, QUIET_M = 0.15, 0.0005
"""The time (s) before and after a force measurement, and the maximum depth change (m) in this time.

Force gauges lag, so forces that were measured during a motion are not used.
"""

MAX_GAP_S = 0.05
"""The maximum time (s) between a measured force and the nearest fingertip and arm messages."""

MIN_DEPTH_M = 0.003
"""The minimum depth (m) of a push.

At smaller depths, errors of the fingertip's position change the expected force too much.
"""

REVERSAL_M = 0.001
"""A push changes between loading and unloading if the depth reverses by more than this (m)."""

MAX_ROWS = 300


def read_pushes(bag: Path) -> tuple[Scene, list[MeasuredPush]]:
    """Return the scene in a bag, and the pushes in which the finger was at rest.

    The pushes are computed from the measured fingertip positions and arm poses.

    Raises SheetModelFitError if the bag contains no scene, or if it contains no valid push.
    """
    scene: Scene | None = None
    tips: list[tuple[int, Floats]] = []
    flanges: dict[str, list[tuple[int, Floats]]] = {"left": [], "right": []}
    forces: list[tuple[int, float]] = []
    topics = ["scene", "fingertip", "arm_left", "arm_right", "force"]
    for _, message, header, _ in BagReader(bag, topics=topics):
        match message:
            case Scene():
                scene = message
            case Fingertip() if message.valid:
                tips.append((header.source_ns, message.position_world_m))
            case ArmState():
                pose = message.world_from_flange.ravel()
                flanges[message.side].append((header.source_ns, pose))
            case Force() if message.valid:
                forces.append((header.source_ns, message.force_n))
            case _:
                pass
    missing = [
        name
        for name, found in (
            ("scene", scene), ("fingertip", tips), ("arm_left", flanges["left"]),
            ("arm_right", flanges["right"]), ("force", forces),
        )
        if not found
    ]  # fmt: skip
    if scene is None or missing:
        raise SheetModelFitError(
            f"the bag has no valid messages of the topics {', '.join(missing)}; record a graph "
            "with a force sensor (docs/library.md)"
        )
    pushes = select_pushes(
        scene,
        sorted(forces),
        make_motion(tips, "fingertip"),
        make_motion(flanges["left"], "arm_left"),
        make_motion(flanges["right"], "arm_right"),
    )
    if not pushes:
        raise SheetModelFitError(
            f"none of the {len(forces)} forces was measured while the finger rested at least "
            f"{1e3 * MIN_DEPTH_M:g} mm deep in the sheet; hold each push for half a second"
        )
    return scene, pushes


def select_pushes(
    scene: Scene,
    forces: list[tuple[int, float]],
    tips: SampledMotion,
    left: SampledMotion,
    right: SampledMotion,
) -> list[MeasuredPush]:
    """Return a push for each force that was measured while the finger was at rest in the sheet.

    If there are more than MAX_ROWS pushes, MAX_ROWS of them are selected evenly.

    forces: (time in ns, force in N) of each measurement.
    tips: positions (3,) of the fingertip.
    left, right: flange poses of the arms. A pose is a matrix (4, 4), flattened to (16,).
    """
    clamps = [pose_matrix(arm.flange_from_edge) for arm in (scene.arms.left, scene.arms.right)]
    half_height_m = 0.5 * scene.sheet.height_m
    pushes: list[MeasuredPush] = []
    unloading, extreme_m = False, 0.0
    for at_ns, force_n in forces:
        if any(_gap_s(motion, at_ns) > MAX_GAP_S for motion in (tips, left, right)):
            continue
        times = at_ns + np.array([-1, 0, 1]) * round(1e9 * QUIET_S)
        edges = [
            motion.interpolate(times).reshape(-1, 4, 4) @ clamp
            for motion, clamp in zip((left, right), clamps, strict=True)
        ]
        found = [
            _locate(tip, *pair) for tip, *pair in zip(tips.interpolate(times), *edges, strict=True)
        ]
        depths = [depth_m for depth_m, _, _ in found]
        depth_m, (x_m, y_m), distance_m = found[1]
        # The extreme depth since the last reversal decides between loading and unloading.
        if (extreme_m - depth_m if not unloading else depth_m - extreme_m) > REVERSAL_M:
            unloading, extreme_m = not unloading, depth_m
        extreme_m = min(extreme_m, depth_m) if unloading else max(extreme_m, depth_m)
        on_sheet = abs(x_m) < 0.5 * distance_m and abs(y_m) < half_height_m
        if not on_sheet or depth_m < MIN_DEPTH_M or max(depths) - min(depths) > QUIET_M:
            continue
        pushes.append(
            MeasuredPush(
                edge_distance_m=distance_m,
                depth_m=depth_m,
                force_n=force_n,
                finger_radius_m=scene.finger.radius_m,
                position_m=(x_m, y_m),
                unloading=unloading,
            )
        )
    chosen = np.unique(np.linspace(0, len(pushes) - 1, MAX_ROWS).round().astype(int))
    return [pushes[index] for index in chosen] if pushes else []


def _gap_s(motion: SampledMotion, at_ns: int) -> float:
    times = motion.times_ns
    index = int(np.searchsorted(times, at_ns))
    near = times[max(index - 1, 0) : index + 1]
    return 1e-9 * float(np.abs(near - at_ns).min())


def _locate(tip: Floats, left: Floats, right: Floats) -> tuple[float, tuple[float, float], float]:
    """Return the depth and position (x, y) of a fingertip, and the distance of the edges, in m.

    The depth is the distance of the fingertip behind the flat sheet between the edges. The position
    is relative to the sheet's centre.

    tip: position (3,) of the fingertip.
    left, right: poses (4, 4) of the clamped edges.
    """
    x_axis, y_axis, normal, centre = flat_axes(left, right)
    offset = tip - centre
    distance_m = float(np.linalg.norm(right[:3, 3] - left[:3, 3]))
    return -float(offset @ normal), (float(offset @ x_axis), float(offset @ y_axis)), distance_m
