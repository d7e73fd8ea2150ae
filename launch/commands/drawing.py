"""`flexsheet graph`: print or draw the nodes and topics of a graph."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flexsheet.launch.commands import options
from flexsheet.launch.commands.graph import running_graph
from flexsheet.launch.commands.output import (
    CommandError,
    examples,
    print_json,
    words,
)

app = options.make_app()


@app.command(
    epilog=examples(
        "flexsheet graph",
        "flexsheet graph launch/lab.yaml -o lab.svg",
        "flexsheet graph demo -o demo.mmd",
    )
)
def graph(
    *,
    launch_file: Annotated[
        Path | None,
        typer.Argument(
            help="Launch file; default: launch file of the running graph.", **options.LAUNCH_FILE
        ),
    ] = None,
    scene: options.OtherSceneOption = None,
    settings: options.SettingsOption = None,
    output: Annotated[
        Path | None, options.result_file("Drawing to write: .svg image, or .mmd file for Mermaid.")
    ] = None,
    run: options.RunOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Print or draw the nodes of a graph, and the topics between them.

    Topics that any number of nodes can publish, such as estop and status, are omitted.
    """
    from flexsheet.launch.plans.drawing import lay_out, list_links, mermaid, svg, text_lines
    from flexsheet.launch.plans.plan import load_graph
    from flexsheet.messages.files import write_file

    if launch_file is None:
        plan, _ = running_graph(run)
    else:
        plan = load_graph(launch_file, settings=options.with_scene(settings, scene))
    if output is not None:
        if output.suffix not in (".svg", ".mmd"):
            raise CommandError(f"--output {output}: unknown file type; name a .svg or .mmd file")
        write_file(output, mermaid(plan) if output.suffix == ".mmd" else svg(lay_out(plan)))
        words.print(f"drawn: {output}")
    if as_json:
        links = [
            {"from": writer, "to": reader, "topics": topics}
            for (writer, reader), topics in list_links(plan).items()
        ]
        nodes = [
            {"node": one.name, "type": one.type, "host": one.host} for one in plan.nodes.values()
        ]
        print_json({"launch_file": plan.launch_file, "nodes": nodes, "links": links})
    elif output is None:
        print("\n".join(text_lines(plan)))
