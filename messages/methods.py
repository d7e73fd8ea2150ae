"""Define the method families of the nodes, and the choice of methods in a scene.

A method family is a set of interchangeable methods for one task (`nodes/methods.py`).  This module
defines their names.  `flexsheet tune SCENE` writes the `methods` of a scene.  A node's parameter
with the value `auto` uses them; any other value overrides them.
"""

from __future__ import annotations

from typing import Annotated, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field

T = TypeVar("T", bound=str | float)

MarkerMethod = Literal["moments", "subpixel_fit"]
TrackingMethod = Literal["none", "one_euro", "adaptive"]
SheetForceMethod = Literal["scaled", "table"]
SheetShapeMethod = Literal["four_triangles", "reduced_order"]
Correction = Literal["none", "one_plane", "four_triangles", "two_pass"]
SoftBodyMethod = Literal["linear", "nonlinear_table"]
ComplianceMode = Literal["force_curve", "stiffness", "constant_stretch"]


class SoftBodyChoice(BaseModel):
    """Method for the deformation of the soft body, and vertex spacing of its surface mesh."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    method: SoftBodyMethod
    skin_spacing_m: Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Methods(BaseModel):
    """Method that a scene chooses from each method family; None: the node's default."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    marker: MarkerMethod | None = None
    tracking: TrackingMethod | None = None
    sheet_force: SheetForceMethod | None = None
    sheet_shape: SheetShapeMethod | None = None
    correction: Correction | None = None
    soft_body: SoftBodyChoice | None = None
    compliance: ComplianceMode | None = Field(
        default=None,
        description="how the sheet renders the object's force; constant_stretch: it does not",
    )


def resolve_method(parameter: T | Literal["auto"], by_scene: T | None, default: T) -> T:
    """Return a node's method; `auto` means the scene's choice, or the default if there is none."""
    if parameter != "auto":
        return parameter
    return default if by_scene is None else by_scene
