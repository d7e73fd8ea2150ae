"""`flexsheet node`: list node types, and describe their ports and parameters."""

from __future__ import annotations

import re
from typing import Annotated, Any

import typer

from flexsheet.launch.commands import complete
from flexsheet.launch.commands.graph import JsonOption, running_graph
from flexsheet.launch.commands.output import (
    BAD_INPUT,
    CommandError,
    examples,
    print_fields,
    print_json,
    print_table,
)

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    help="List and describe nodes.",
)


@app.command(
    "list",
    epilog=examples("flexsheet node list"),
)
def list_nodes(as_json: JsonOption = False) -> None:
    """List the node types for launch files, and the nodes of the running graph."""
    from flexsheet.launch.running.runs import list_live_runs
    from flexsheet.nodes import NODES

    running: dict[str, list[str]] = {}
    if list_live_runs():
        plan, _ = running_graph(None)
        for node in plan.nodes.values():
            running.setdefault(node.type, []).append(node.name)
    types = {**NODES, **{name: name for name in running if name not in NODES}}
    if as_json:
        print_json(
            [
                {"type": name, "class": path, "running": running.get(name, [])}
                for name, path in types.items()
            ]
        )
    else:
        print_table(
            ("type", "class", "running as"),
            [(name, path, ", ".join(running.get(name, []))) for name, path in types.items()],
        )


@app.command(
    epilog=examples(
        "flexsheet node describe planner",
        "flexsheet node describe my_package.my_node:MyNode --json",
    )
)
def describe(
    node: Annotated[
        str,
        typer.Argument(
            help='Node type of the project, or "module:Class".', autocompletion=complete.node_types
        ),
    ],
    as_json: JsonOption = False,
) -> None:
    """Print the ports, timers and parameters of a node type."""
    from flexsheet.nodes import UnknownNodeError, node_class
    from flexsheet.nodes.node import find_parameters_type, find_ports, find_timers

    try:
        class_ = node_class(node)
    except (UnknownNodeError, ImportError, AttributeError) as error:
        raise CommandError(str(error), BAD_INPUT) from error
    description = {
        "type": node,
        "about": (class_.__doc__ or "").strip(),
        "ports": [
            {"port": port.name, "direction": port.direction, "message": port.message.__name__}
            for port in find_ports(class_).values()
        ],
        "timers": [
            {"method": timer.method, "rate_parameter": timer.rate_parameter}
            for timer in find_timers(class_)
        ],
        "parameters": [
            _parameter(name, field)
            for name, field in find_parameters_type(class_).model_fields.items()
        ],
    }
    if as_json:
        print_json(description)
        return
    print_fields([("type", node), ("about", str(description["about"]).split("\n")[0])])
    for title in ("ports", "timers", "parameters"):
        rows: Any = description[title]
        if rows:
            print()
            print_table(tuple(rows[0]), [tuple(row.values()) for row in rows])


def _parameter(name: str, field: Any) -> dict[str, Any]:
    from flexsheet.messages.field_types import describe_field_type

    # Same text as in docs/parameters.md, without the links.
    kind = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", describe_field_type(field))
    kind = re.sub(r"[`\\]", "", kind)
    return {
        "parameter": name,
        "type": kind,
        "default": "required" if field.is_required() else str(field.get_default()),
        "about": field.description or "",
    }
