"""Define the method families of the nodes, and the choice of methods in a scene.

A method family is a set of interchangeable ways to do one thing (`nodes/methods.py`); here are the
names that nodes know theirs by.  `flexsheet tune SCENE` writes a scene's `methods`; a node's
parameter that says `auto` follows them, and what the node's parameters say else goes before.
"""

from __future__ import annotations

from typing import Annotated, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field

T = TypeVar("T", bound=str | float)

MarkerMethod = Literal["moments", "weighted_centroid", "subpixel_fit"]
TriangulationMethod = Literal["dlt"]
TrackingMethod = Literal["none", "one_euro", "adaptive"]
SheetForceMethod = Literal["linear", "scaled", "table"]
SheetShapeMethod = Literal["four_triangles", "reduced_order"]
Correction = Literal["none", "one_plane", "four_triangles", "two_pass"]
SoftBodyMethod = Literal["linear", "nonlinear_table"]


class SoftBodyChoice(BaseModel):
    """How the soft body is answered for, and on how fine a mesh."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    method: SoftBodyMethod
    skin_spacing_m: Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Methods(BaseModel):
    """A scene's choice for each family; of one that is left out, the node's own default holds."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    marker: MarkerMethod | None = None
    triangulation: TriangulationMethod | None = None
    tracking: TrackingMethod | None = None
    sheet_force: SheetForceMethod | None = None
    sheet_shape: SheetShapeMethod | None = None
    correction: Correction | None = None
    soft_body: SoftBodyChoice | None = None


def chosen(asked: T | Literal["auto"], by_scene: T | None, default: T) -> T:
    """What a node takes: what its parameter says, else the scene's choice, else its default."""
    if asked != "auto":
        return asked
    return default if by_scene is None else by_scene
