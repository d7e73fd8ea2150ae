"""Define the names of the methods between which nodes can choose.

A method family is a set of interchangeable methods for one task (`nodes/methods.py`). The command
`flexsheet tune SCENE` names the best methods for the key `methods` of a scene. A node uses these
methods if its parameter has the value `auto`. Any other value of the parameter overrides the scene.
"""

from __future__ import annotations

from typing import Annotated, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from flexsheet.messages.limits import LimitedModel

T = TypeVar("T", bound=str | float)

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
    """The methods that a scene chooses for the nodes, one for each task.

    None means that the node uses its default method.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    sheet_shape: SheetShapeMethod | None = None
    correction: Correction | None = None
    soft_body: SoftBodyChoice | None = None
    compliance: ComplianceMode | None = Field(
        default=None,
        description="how the sheet renders the object's force; "
        "constant_stretch: the force is not rendered",
    )


def resolve_method(parameter: T | Literal["auto"], by_scene: T | None, default: T) -> T:
    """Return the method that a node uses.

    parameter: value of the node's parameter; "auto" selects the scene's choice.
    by_scene: choice of the scene; None means `default`.
    """
    if parameter != "auto":
        return parameter
    return default if by_scene is None else by_scene
