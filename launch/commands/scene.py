"""`flexsheet scene`: print the schema of scene files, and export a scene to other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flexsheet.launch.commands.options import SCENE, JsonOption, make_app, result_file
from flexsheet.launch.commands.output import examples, print_json, words

app = make_app()


@app.command(epilog=examples("flexsheet scene", "flexsheet scene cylinder -o cylinder.urdf"))
def export(
    scene: Annotated[
        Path | None,
        typer.Argument(help="Scene to export; without it, the schema is printed.", **SCENE),
    ] = None,
    output: Annotated[
        Path | None, result_file("URDF file to write; default: print the text.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Print the JSON Schema of scene files, or write a URDF model of a scene's devices.

    With the schema, editors complete and check the keys of a scene file.

    The URDF model of SCENE contains the arms, clamps, cameras and projector.
    The joints are named left_joint_1 to left_joint_6 and right_joint_1 to right_joint_6. They can
    be moved in a viewer. The model contains geometry and joint limits, but no masses or torques.
    """
    from flexsheet.launch.plans.plan import load_scene
    from flexsheet.launch.viewing.apparatus_model import make_model
    from flexsheet.launch.viewing.urdf import make_urdf
    from flexsheet.messages.files import write_file
    from flexsheet.messages.scene import Scene

    if scene is None:
        print_json(Scene.model_json_schema())
        return

    model = make_model(load_scene(scene))
    if output is not None:
        write_file(output, make_urdf(model))
        words.print(f"wrote {output}")
    if as_json:
        print_json(
            {
                "scene": model.name,
                "output": None if output is None else str(output),
                "links": [link.name for link in model.links],
                "joints": [joint.name for joint in model.joints if joint.limit is not None],
            }
        )
    elif output is None:
        print(make_urdf(model), end="")
