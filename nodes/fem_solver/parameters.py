"""Define the soft body node's parameters, as a launch file gives them."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from flexsheet.messages.scene import NonNegative, Positive
from flexsheet.nodes.fem_solver.soft_body_factory import MethodChoice
from flexsheet.nodes.node import NodeParameters


class FemSolverParameters(NodeParameters):
    method: MethodChoice = Field(
        default="auto",
        description="Method of the soft body. auto: the scene's, else the nonlinear table if it is "
        "cached, else linear. nonlinear_table: computed in the background if it is not cached, "
        "which takes minutes.",
    )
    skin_spacing_m: Positive | Literal["auto"] = Field(
        default="auto",
        description="Distance between touchable skin nodes. auto: the scene's, else 0.003.",
    )
    compute_table: bool = Field(
        default=False,
        description="Compute the nonlinear table in the background if the scene chooses it and it "
        "is not cached.",
    )
    linear_depth_m: Positive = Field(
        default=0.006,
        description="Maximum depth of the linear method; deeper pushes are reported out of range.",
    )
    max_depth_m: Positive = Field(
        default=0.010,
        description="Limit of the deflection with the linear method.",
    )
    friction_ratio: NonNegative = Field(
        default=0.0,
        description="Friction coefficient between finger and object. Above 0 the linear method is "
        "used.",
    )
    step_budget_s: Positive = Field(
        default=0.004,
        description="Maximum duration of a step; five consecutive late steps change the method.",
    )
    workers: int = Field(
        default=0, ge=0, description="Number of worker processes for a table. 0: one per core."
    )
    scheduler: str | None = Field(
        default=None,
        description="Address of a dask.distributed scheduler, such as tcp://host:8786, whose "
        "workers compute the table. null: this machine's cores.",
    )
    prediction_horizon_s: NonNegative = Field(
        default=0.0, description="Prediction time of the fingertip after its exposure."
    )
    hold_s: NonNegative = Field(
        default=0.1, description="Time for which the deformation remains after the finger is lost."
    )
    relax_s: Positive = Field(
        default=0.15, description="Time constant of the deformation's decay after `hold_s`."
    )
    cache_dir: Path | None = Field(
        default=None, description="Folder of precomputed results. null: the user's cache."
    )
