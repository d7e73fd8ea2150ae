"""Read the arm models of a scene file that refers to URDF files.

A scene file can give the model of an arm as

model: {urdf: ur5e.urdf, base: base_link, tip: tool0, start_rad: [...]}

with a path relative to the scene file. The scene message contains the resulting joint chain.
Therefore only the computer that reads the scene file needs the package yourdfpy.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ConfigDict, Field

from flexsheet.launch.plans.documents import Document, validate
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.limits import LimitedModel
from flexsheet.messages.scene import JointChain, Pose, Six
from flexsheet.nodes.arrays import Floats
from flexsheet.nodes.models.rigid import rpy_from_rotation

JOINTS = 6
MAX_BYTES = 4 << 20
CONTINUOUS_RANGE_RAD = 2.0 * np.pi
"""The assumed range of a joint that has no limits: one revolution in both directions.

This range protects the cables of the arm.
"""


class UrdfError(FlexsheetError, ValueError):
    """Raised if a URDF file does not describe a usable arm."""

    remedy = "Correct the URDF file or the links `base` and `tip` of the scene file."


class UrdfArm(LimitedModel):
    """An arm model that a scene file specifies by the path of a URDF file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    urdf: str = Field(description="path of the URDF file, relative to the scene file")
    base: str = Field(description="link at which the arm is mounted")
    tip: str = Field(description="link that is the flange")
    start_rad: Six = Field(
        description="six joint angles, rad, at which the arm reaches towards the sheet"
    )


def load_arm_models(document: Document) -> None:
    """Replace references to URDF files in a parsed scene file by joint chains.

    Raises BadInputError if a reference or a URDF file is invalid.
    """
    for side in ("left", "right"):
        at = ("arms", side, "model")
        model = document.find(at)
        if not (isinstance(model, dict) and "urdf" in model):
            continue
        given = validate(UrdfArm, document, at=at)
        try:
            chain = read_urdf(
                document.path.parent / given.urdf, given.base, given.tip, given.start_rad
            )
        except UrdfError as error:
            raise document.error((*at, "urdf"), f'"{given.urdf}": {error}', error.remedy) from error
        document.values["arms"][side]["model"] = chain.model_dump()


def read_urdf(path: Path, base: str, tip: str, start_rad: Six) -> JointChain:
    """Read the chain of six rotary joints between two links of a URDF file.

    start_rad: start angles of the joints, at which the arm reaches towards the sheet.

    Raises UrdfError if the file does not describe such a chain.
    """
    joints = {joint.child: joint for joint in _load_joints(path)}
    chain: list[Any] = []
    link = tip
    while link != base:
        if link not in joints:
            raise UrdfError(
                f'no chain of joints leads from link "{base}" to link "{tip}"; correct `base` or '
                "`tip`"
            )
        chain.insert(0, joints.pop(link))
        link = chain[0].parent
    origins, axes, limits = list[Floats](), list[Floats](), list[tuple[float, float, float]]()
    pending = np.eye(4)
    for joint in chain:
        pending = pending if joint.origin is None else pending @ joint.origin
        if joint.type == "fixed":
            continue
        limits.append(_find_limits(joint))
        origins.append(pending)
        axis = np.array([1.0, 0.0, 0.0] if joint.axis is None else joint.axis, dtype=np.float64)
        length = float(np.linalg.norm(axis))
        if not length > 0.0:
            raise UrdfError(f'joint "{joint.name}": the axis is zero; give a direction')
        axes.append(axis / length)
        pending = np.eye(4)
    if len(origins) != JOINTS:
        raise UrdfError(
            f'the chain from "{base}" to "{tip}" has {len(origins)} rotary joints; {JOINTS} are '
            "required"
        )
    lowest, highest, speeds = zip(*limits, strict=True)
    try:
        return JointChain(
            name=path.stem,
            min_rad=lowest,
            max_rad=highest,
            speed_rad_per_s=speeds,
            start_rad=start_rad,
            origins=tuple(_make_pose(one) for one in origins),  # type: ignore[arg-type]
            axes=tuple(axes),  # type: ignore[arg-type]
            flange=_make_pose(pending),
        )
    except ValueError as error:
        raise UrdfError(str(error)) from error


def _load_joints(path: Path) -> list[Any]:
    # An optional package without types; mypy also runs where it is not installed.
    import yourdfpy  # type: ignore[import-untyped,import-not-found,unused-ignore]

    try:
        if path.stat().st_size > MAX_BYTES:
            raise UrdfError(f"the file is larger than {MAX_BYTES >> 20} MiB")
        robot = yourdfpy.URDF.load(str(path), build_scene_graph=False, load_meshes=False)
    except OSError as error:
        raise UrdfError(f"the file cannot be read: {error.strerror}; check the path") from error
    except UrdfError:
        raise
    except Exception as error:  # The library does not convert errors of XML and of number parsing.
        raise UrdfError(f"the file is not valid URDF: {error}") from error
    return list(robot.robot.joints)


def _find_limits(joint: Any) -> tuple[float, float, float]:
    """Return the lower and upper angle (rad) and the maximum speed (rad/s) of a joint."""
    if joint.type not in {"revolute", "continuous"} or joint.mimic is not None:
        raise UrdfError(
            f'joint "{joint.name}" of type {joint.type}: only independent rotary joints can be used'
        )
    limit = joint.limit
    if limit is None or not limit.velocity:
        raise UrdfError(f'joint "{joint.name}": give `limit` with a `velocity` above 0')
    if joint.type == "continuous":
        return -CONTINUOUS_RANGE_RAD, CONTINUOUS_RANGE_RAD, float(limit.velocity)
    if limit.lower is None or limit.upper is None:
        raise UrdfError(f'joint "{joint.name}": give `lower` and `upper` in its `limit`')
    return float(limit.lower), float(limit.upper), float(limit.velocity)


def _make_pose(matrix: Floats) -> Pose:
    return Pose(position_m=matrix[:3, 3], rpy_rad=rpy_from_rotation(matrix[:3, :3]))
