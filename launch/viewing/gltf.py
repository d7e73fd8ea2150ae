"""Write the model of the haptic display as glTF 2.0, for 3D viewers and modelling programs.

Each joint and each link is a glTF node of the same name. The node of a joint contains the nodes of
all following links, and its `extras` contain the axis and the range of the joint. As is usual in
glTF, y points up and z points to the user.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import trimesh
from trimesh.exchange import gltf
from trimesh.visual import material

from flexsheet.launch.viewing.apparatus_model import WORLD, ApparatusModel, Box

GLTF_FILE = "model.gltf"

# These parts of trimesh have no type annotations.
_gltf: Any = gltf
_material: Any = material
_visual: Any = trimesh.visual


def make_glb(model: ApparatusModel, angles_rad: Mapping[str, float]) -> bytes:
    """Return the model, at the given joint angles, as binary glTF.

    angles_rad: joint angles by joint name.
    """
    return bytes(_gltf.export_glb(_make_scene(model, angles_rad)))


def make_gltf(model: ApparatusModel, angles_rad: Mapping[str, float]) -> str:
    """Return the model, at the given joint angles, as glTF JSON with embedded meshes.

    angles_rad: joint angles by joint name.
    """
    scene = _make_scene(model, angles_rad)
    files = _gltf.export_gltf(scene, merge_buffers=True, embed_buffers=True)
    return json.dumps(json.loads(files[GLTF_FILE]), indent=1) + "\n"


def _make_scene(model: ApparatusModel, angles_rad: Mapping[str, float]) -> Any:
    scene: Any = trimesh.Scene(base_frame=WORLD)
    for joint in model.joints:
        extras: dict[str, Any] = {}
        if joint.limit is not None:
            extras = {"axis": joint.limit.axis}
            extras |= {"min_rad": joint.limit.min_rad, "max_rad": joint.limit.max_rad}
        pose = joint.pose(angles_rad.get(joint.name, 0.0))
        scene.graph.update(joint.name, joint.parent, matrix=pose, metadata=extras)
        scene.graph.update(joint.child, joint.name, matrix=np.eye(4))
    for link in model.links:
        for number, box in enumerate(link.boxes):
            name = f"{link.name}_{number}"
            link_from_box = np.eye(4)
            link_from_box[:3, 3] = box.centre_m
            scene.add_geometry(
                _make_mesh(box),
                node_name=name,
                geom_name=name,
                parent_node_name=link.name,
                transform=link_from_box,
            )
    return scene


def _make_mesh(box: Box) -> Any:
    mesh: Any = trimesh.creation.box(box.size_m)
    # With separate vertices for each face, viewers draw sharp edges.
    mesh.unmerge_vertices()
    mesh.visual = _visual.TextureVisuals(
        material=_material.PBRMaterial(
            baseColorFactor=[round(255 * value) for value in box.colour],
            metallicFactor=0.0,
            roughnessFactor=0.8,
            alphaMode="OPAQUE" if box.colour[3] == 1.0 else "BLEND",
        )
    )
    return mesh
