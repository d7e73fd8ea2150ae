"""Define the parameters of the soft-body node that a launch file can set."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from flexsheet.messages.methods import SoftBodyMethod
from flexsheet.messages.scene import NonNegative, Positive
from flexsheet.nodes.node import NodeParameters


class FemSolverParameters(NodeParameters):
    method: SoftBodyMethod | None = Field(
        default=None,
        description="Method that computes the deformation. null: the method of the scene.",
    )
    skin_spacing_m: Positive | None = Field(
        default=None,
        description="Distance between mesh nodes on the touchable surface. null: the value of the "
        "scene.",
    )
    prediction_horizon_s: NonNegative = Field(
        default=0.0,
        description="Time from the camera exposure to the predicted fingertip position.",
    )
    hold_s: NonNegative = Field(
        default=0.1, description="Time for which the deformation is kept after the finger is lost."
    )
    relax_s: Positive = Field(
        default=0.15,
        description="Time constant with which the deformation decays after the time `hold_s`.",
    )
    cache_dir: Path | None = Field(
        default=None,
        description="Folder of precomputed results. null: the user's cache folder is used.",
    )
