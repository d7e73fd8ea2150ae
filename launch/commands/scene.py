"""`flexsheet scene`: print the schema of scene files, and export a scene to other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from flexsheet.launch.commands.options import JsonOption, SceneArgument, make_app, result_file
from flexsheet.launch.commands.output import (
    CommandError,
    examples,
    print_json,
    words,
)

app = make_app("Print the JSON Schema of scene files, and export a scene to other tools.")


SUFFIXES = {".urdf": "urdf", ".xml": "urdf", ".gltf": "gltf", ".glb": "gltf"}
"""The format of an exported model for each suffix of the file name."""


@app.command(epilog=examples("flexsheet scene schema"))
def schema(as_json: JsonOption = False) -> None:
    """Print the JSON Schema of scene files, with which editors complete and check keys."""
    from flexsheet.messages.scene import Scene

    print_json(Scene.model_json_schema())


@app.command(
    epilog=examples(
        "flexsheet scene export cylinder -o cylinder.urdf",
        "flexsheet scene export cylinder -o cylinder.glb",
        "flexsheet scene export organ --format urdf",
    )
)
def export(
    scene: SceneArgument,
    form: Annotated[
        Literal["urdf", "gltf"] | None,
        typer.Option(
            "--format", metavar="urdf|gltf", help="Format; default: determined by the file name."
        ),
    ] = None,
    output: Annotated[
        Path | None,
        result_file("File to write: .urdf, .gltf, or .glb (binary glTF); default: print the text."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write a URDF or glTF model of the arms, clamps, camera, projector and screen.

    The joints are named left_joint_1 to left_joint_6 and right_joint_1 to right_joint_6. They can
    be moved in a viewer. The model contains geometry and joint limits, but no masses or torques.
    """
    from flexsheet.launch.plans.plan import load_scene
    from flexsheet.launch.viewing.apparatus_model import make_model, solve_rest_joints
    from flexsheet.launch.viewing.gltf import make_glb, make_gltf
    from flexsheet.launch.viewing.urdf import make_urdf
    from flexsheet.messages.files import write_file

    found: str = form or "urdf"
    if output is not None:
        if output.suffix not in SUFFIXES:
            raise CommandError(
                f"--output {output}: unknown file type; name a .urdf, .gltf or .glb file"
            )
        found = form or SUFFIXES[output.suffix]
        if SUFFIXES[output.suffix] != found:
            raise CommandError(
                f"--format {found}: {output} has the suffix of another format; change one of them"
            )
    loaded = load_scene(scene)
    model = make_model(loaded)
    content: str | bytes
    if found == "urdf":
        content = make_urdf(model)
    elif output is not None and output.suffix == ".glb":
        content = make_glb(model, solve_rest_joints(loaded))
    else:
        content = make_gltf(model, solve_rest_joints(loaded))
    if output is not None:
        write_file(output, content)
        words.print(f"wrote {output}")
    if as_json:
        print_json(
            {
                "scene": loaded.name,
                "format": found,
                "output": None if output is None else str(output),
                "links": [link.name for link in model.links],
                "joints": [joint.name for joint in model.joints if joint.limit is not None],
            }
        )
    elif output is None:
        print(content, end="")
