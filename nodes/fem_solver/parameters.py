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
        "cached, else linear. nonlinear_table: computed in the background, in minutes, if it is "
        "not cached.",
    )
    skin_spacing_m: Positive | Literal["auto"] = Field(
        default="auto",
        description="Distance of skin nodes where fingers touch. auto: the scene's, else 0.003.",
    )
    linear_depth_m: Positive = Field(
        default=0.006,
        description="Maximum depth of the linear method; deeper pushes are reported out of range.",
    )
    max_depth_m: Positive = Field(
        default=0.010,
        description="Depth that the skin approaches in deeper pushes with the linear method.",
    )
    friction_ratio: NonNegative = Field(
        default=0.0,
        description="Friction coefficient above which a sticking finger slips. 0: it slides "
        "without friction. Above 0 the linear method is used.",
    )
    step_budget_s: Positive = Field(
        default=0.004,
        description="Maximum duration of a step; five consecutive longer ones change the method.",
    )
    workers: int = Field(
        default=0, ge=0, description="Number of processes that compute a table. 0: one per core."
    )
    scheduler: str | None = Field(
        default=None,
        description="Address of a dask.distributed scheduler, such as tcp://host:8786, whose "
        "workers compute the table. null: this machine's cores.",
    )
    prediction_horizon_s: NonNegative = Field(
        default=0.0, description="Time by which the fingertip is predicted ahead."
    )
    hold_s: NonNegative = Field(
        default=0.1, description="Time for which the indentation of a lost finger remains."
    )
    relax_s: Positive = Field(
        default=0.15, description="Time constant of the skin's recovery after that."
    )
    cache_dir: Path | None = Field(
        default=None, description="Folder of precomputed results. null: the user's cache."
    )
