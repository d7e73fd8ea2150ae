"""Define the parameters of the soft-body node that a launch file can set."""

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
        description="Method that computes the deformation. auto: the method that the scene "
        "specifies is used, or nonlinear_table if the scene specifies none. nonlinear_table: a "
        "missing table is computed in the background. A coarse table is ready after about a "
        "minute.",
    )
    skin_spacing_m: Positive | Literal["auto"] = Field(
        default="auto",
        description="Distance between mesh nodes on the touchable surface. auto: the value that "
        "the scene specifies is used, or 0.003 if the scene specifies none.",
    )
    compute_table: bool = Field(
        default=True,
        description="Whether a missing nonlinear table is computed in the background if the "
        "method is auto. false: the linear method is used until the table is in the cache.",
    )
    linear_depth_m: Positive = Field(
        default=0.006,
        description="Maximum push depth of the linear method. Deeper pushes are reported as out "
        "of range.",
    )
    max_depth_m: Positive = Field(
        default=0.010,
        description="Maximum push depth for the deformation with the linear method. Deeper pushes "
        "deform the object no further.",
    )
    friction_ratio: NonNegative = Field(
        default=0.0,
        description="Friction coefficient between finger and object. 0: the finger slides without "
        "friction. If it is above 0, the linear method is used.",
    )
    step_budget_s: Positive = Field(
        default=0.004,
        description="Maximum duration of the computation for one fingertip message. After five "
        "consecutive computations that take longer, another method is used.",
    )
    workers: int = Field(
        default=0,
        ge=0,
        description="Number of processes that compute a nonlinear table. 0: one process per "
        "core is used.",
    )
    scheduler: str | None = Field(
        default=None,
        description="Address of a dask.distributed scheduler, such as tcp://host:8786, whose "
        "workers compute the nonlinear table. null: processes of this computer compute it.",
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
