"""Read the calibration files that the nodes of a graph use in addition to the scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.messages.calibration import StereoCalibration
from flexsheet.messages.marker_calibration import MarkerCalibration
from flexsheet.messages.scene import Scene
from flexsheet.messages.sheet_calibration import SheetCalibration
from flexsheet.nodes import node_class
from flexsheet.nodes.models.finger_frame import world_from_finger

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class NodeCalibrations:
    """The calibrations of stereo camera, sheet and marker that the nodes use.

    If a field is None, the nodes use the value of the scene.

    stamp_offset_s: time that the camera node adds to timestamps.
    """

    stereo: StereoCalibration | None = None
    sheet: SheetCalibration | None = None
    marker: MarkerCalibration | None = None
    stamp_offset_s: float = 0.0

    @staticmethod
    def of(plan: ResolvedGraph) -> NodeCalibrations:
        """Read the calibrations of the camera node, the triangulator and the planner of a graph."""
        stereo: StereoCalibration | None = None
        sheet: SheetCalibration | None = None
        marker: MarkerCalibration | None = None
        stamp_offset_s = 0.0
        for node in plan.nodes.values():
            kind = node_class(node.type)
            if issubclass(kind, node_class("camera")):
                stamp_offset_s = node.parameters["stamp_offset_s"]
            if issubclass(kind, node_class("triangulator")):
                if path := node.parameters["calibration"]:
                    stereo = StereoCalibration.load(Path(path))
                if path := node.parameters["marker_calibration"]:
                    marker = MarkerCalibration.load(Path(path))
            if issubclass(kind, node_class("planner")) and node.parameters["sheet_calibration"]:
                sheet = SheetCalibration.load(Path(node.parameters["sheet_calibration"]))
        return NodeCalibrations(stereo, sheet, marker, stamp_offset_s)

    def find_marker_offset_m(self, scene: Scene) -> Floats:
        """Return the vector (3,), m, from the finger pad to the marker, in world axes.

        The marker calibration takes precedence over the scene.
        """
        marker = scene.finger if self.marker is None else self.marker
        turned = world_from_finger(scene.finger.direction_world)
        return np.asarray(turned @ np.array(marker.marker_from_pad_m))
