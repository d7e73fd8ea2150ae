"""Write the model of the haptic display as URDF, for RViz, Foxglove, MuJoCo and other tools."""

from __future__ import annotations

from collections.abc import Iterable
from xml.etree import ElementTree as xml

from flexsheet.launch.viewing.apparatus_model import ApparatusModel, Box, Joint, Link
from flexsheet.nodes.models.rigid import rpy_from_rotation

UNKNOWN_EFFORT = "0"
"""The value of the required attribute `effort`. It is zero, because the torques are unknown."""


def make_urdf(model: ApparatusModel) -> str:
    """Return the model as URDF text, with lengths in m and angles in rad.

    The angles `rpy` are rotations about the fixed x, y and z axes, in this order.
    """
    robot = xml.Element("robot", name=f"flexsheet_{model.name}")
    # By default MuJoCo would merge fixed links into the world and discard visual shapes.
    mujoco = xml.SubElement(robot, "mujoco")
    xml.SubElement(mujoco, "compiler", fusestatic="false", discardvisual="false")
    for link in model.links:
        robot.append(_make_link(link))
    for joint in model.joints:
        robot.append(_make_joint(joint))
    xml.indent(robot)
    return '<?xml version="1.0"?>\n' + xml.tostring(robot, encoding="unicode") + "\n"


def _make_link(link: Link) -> xml.Element:
    element = xml.Element("link", name=link.name)
    for number, box in enumerate(link.boxes):
        for kind in ("visual", "collision"):
            name = f"{link.name}_{kind}_{number}"
            shape = _make_shape(box, xml.SubElement(element, kind, name=name))
            if kind == "visual":
                material = xml.SubElement(shape, "material", name=f"{link.name}_{number}")
                xml.SubElement(material, "color", rgba=_join(box.colour))
    return element


def _make_shape(box: Box, parent: xml.Element) -> xml.Element:
    xml.SubElement(parent, "origin", xyz=_join(box.centre_m), rpy="0 0 0")
    xml.SubElement(xml.SubElement(parent, "geometry"), "box", size=_join(box.size_m))
    return parent


def _make_joint(joint: Joint) -> xml.Element:
    kind = "fixed" if joint.limit is None else "revolute"
    element = xml.Element("joint", name=joint.name, type=kind)
    pose = joint.parent_from_child
    rpy = rpy_from_rotation(pose[:3, :3])
    xml.SubElement(element, "origin", xyz=_join(pose[:3, 3]), rpy=_join(rpy))
    xml.SubElement(element, "parent", link=joint.parent)
    xml.SubElement(element, "child", link=joint.child)
    if joint.limit is not None:
        limit = joint.limit
        xml.SubElement(element, "axis", xyz=_join(limit.axis))
        xml.SubElement(
            element,
            "limit",
            lower=repr(limit.min_rad),
            upper=repr(limit.max_rad),
            velocity=repr(limit.max_speed_rad_per_s),
            effort=UNKNOWN_EFFORT,
        )
    return element


def _join(values: Iterable[float]) -> str:
    """Format numbers with all digits, separated by spaces."""
    return " ".join(repr(float(value)) for value in values)
