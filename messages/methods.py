"""Define the names of the methods between which nodes can choose.

A method family is a set of interchangeable methods for one task (`nodes/methods.py`). The command
`flexsheet tune SCENE` names the best methods for the key `methods` of a scene. A node uses these
methods unless a parameter of the launch file overrides them.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from flexsheet.messages.limits import LimitedModel

SheetShapeMethod = Literal["four_triangles", "reduced_order"]
Correction = Literal["none", "one_plane", "four_triangles", "two_pass"]
SoftBodyMethod = Literal["linear", "nonlinear_table"]
ComplianceMode = Literal["force_curve", "stiffness", "constant_stretch"]


class SoftBodyChoice(LimitedModel):
    """The method for the soft body's deformation, and the vertex spacing of its surface mesh."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    method: SoftBodyMethod
    skin_spacing_m: Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Methods(BaseModel):
    """The methods that a scene chooses for the nodes, one for each task."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    sheet_shape: SheetShapeMethod = "reduced_order"
    correction: Correction = "two_pass"
    soft_body: SoftBodyChoice = SoftBodyChoice(method="nonlinear_table", skin_spacing_m=0.003)
    compliance: ComplianceMode = Field(
        default="force_curve",
        description="how the sheet renders the object's force; stiffness: only by the stretch, as "
        "in Furukawa et al. 2007; constant_stretch: the force is not rendered",
    )
