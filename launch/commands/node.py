"""`flexsheet node`: list nodes and node types, and describe their ports and parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from flexsheet.launch.commands import complete
from flexsheet.launch.commands.graph import NoGraphError, running_graph
from flexsheet.launch.commands.options import JsonOption, RunOption, make_app
from flexsheet.launch.commands.output import (
    CommandError,
    examples,
    print_fields,
    print_json,
    print_rows,
)

if TYPE_CHECKING:
    from flexsheet.launch.plans.plan_model import ResolvedNode

app = make_app("List nodes and node types, and describe their ports and parameters.")


@app.command("list", epilog=examples("flexsheet node list"))
def list_nodes(run: RunOption = None, as_json: JsonOption = False) -> None:
    """List the nodes of the running graph."""
    plan, _ = running_graph(run)
    rows = [
        {"node": node.name, "type": node.type, "host": node.host} for node in plan.nodes.values()
    ]
    print_rows(rows, as_json=as_json)


@app.command("types", epilog=examples("flexsheet node types"))
def list_types(as_json: JsonOption = False) -> None:
    """List the node types that launch files can use."""
    from flexsheet.nodes import NODES

    print_rows([{"type": name, "class": path} for name, path in NODES.items()], as_json=as_json)


@app.command(
    epilog=examples(
        "flexsheet node info planner",
        "flexsheet node info my_package.my_node:MyNode --json",
    )
)
def info(
    node: Annotated[
        str,
        typer.Argument(
            help='Name of a node of the running graph, or a node type (name or "module:Class").',
            autocompletion=complete.nodes,
        ),
    ],
    run: RunOption = None,
    as_json: JsonOption = False,
) -> None:
    """Print the ports, timers and parameters of a node or of a node type.

    For a node of the running graph, the connected topics and the parameter values are also printed.
    """
    from flexsheet.nodes import UnknownNodeError, node_class
    from flexsheet.nodes.node import find_parameters_type, find_ports, find_timers

    try:
        found = running_graph(run)[0].nodes.get(node)
    except NoGraphError:
        found = None
    node_type = node if found is None else found.type
    try:
        class_ = node_class(node_type)
    except (UnknownNodeError, ImportError, AttributeError) as error:
        raise CommandError(str(error)) from error
    description = {
        **({} if found is None else {"node": node, "host": found.host}),
        "type": node_type,
        "about": (class_.__doc__ or "").strip(),
        "ports": [
            {
                "port": port.name,
                "direction": port.direction,
                "message": port.message.__name__,
                **({} if found is None else {"topic": _find_topic(found, port.name)}),
            }
            for port in find_ports(class_).values()
        ],
        "timers": [
            {"method": timer.method, "rate_parameter": timer.rate_parameter}
            for timer in find_timers(class_)
        ],
        "parameters": [
            {
                **_parameter(name, field),
                **({} if found is None else {"value": found.parameters.get(name)}),
            }
            for name, field in find_parameters_type(class_).model_fields.items()
        ],
    }
    if as_json:
        print_json(description)
        return
    print_fields(
        (name, str(value).split("\n")[0])
        for name, value in description.items()
        if isinstance(value, str)
    )
    for title in ("ports", "timers", "parameters"):
        rows: Any = description[title]
        if rows:
            print()
            print_rows(rows, as_json=False)


def _find_topic(node: ResolvedNode, port: str) -> str | None:
    """Return the topic to which a port of a node is connected; None if it is not connected."""
    ports = (*node.inputs, *node.outputs)
    return next((one.topic for one in ports if one.port == port and one.endpoints), None)


def _parameter(name: str, field: Any) -> dict[str, str]:
    from flexsheet.messages.field_types import describe_field

    return {"parameter": name, **describe_field(field)}
