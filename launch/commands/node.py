"""`flexsheet node`: list nodes and node types, and describe their ports and parameters."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from flexsheet.launch.commands.graph import NoGraphError, running_graph
from flexsheet.launch.commands.options import JsonOption, RunOption, make_app
from flexsheet.launch.commands.output import (
    CommandError,
    examples,
    print_fields,
    print_json,
    print_rows,
    words,
)

app = make_app("List nodes and node types, and describe their ports and parameters.")


@app.command("list", epilog=examples("flexsheet node list", "flexsheet node list --all"))
def list_nodes(
    list_all: Annotated[
        bool, typer.Option("--all", help="List the node types that launch files can use.")
    ] = False,
    run: RunOption = None,
    as_json: JsonOption = False,
) -> None:
    """List the nodes of the running graph, or the node types that launch files can use.

    If no graph is running, the node types are listed.
    """
    from flexsheet.nodes import NODES

    rows = [{"type": name, "class": path} for name, path in NODES.items()]
    if not list_all:
        try:
            plan, _ = running_graph(run)
        except NoGraphError as error:
            words.print(f"{error}; all node types follow")
        else:
            rows = [
                {"node": node.name, "type": node.type, "host": node.host}
                for node in plan.nodes.values()
            ]
    print_rows(rows, as_json=as_json)


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
        ),
    ],
    run: RunOption = None,
    as_json: JsonOption = False,
) -> None:
    """Print the ports, timers and parameters of a node or of a node type.

    If the node is in the running graph, the command also prints its connected topics and its
    parameter values.
    """
    from flexsheet.messages.field_types import describe_field
    from flexsheet.nodes import NodeImportError, UnknownNodeError, node_class
    from flexsheet.nodes.node import find_parameters_type, find_ports, find_timers

    try:
        found = running_graph(run)[0].nodes.get(node)
    except NoGraphError:
        found = None
    node_type = node if found is None else found.type
    try:
        class_ = node_class(node_type)
    except (UnknownNodeError, NodeImportError) as error:
        raise CommandError(str(error)) from error
    fields = {"type": node_type, "about": (class_.__doc__ or "").strip()}
    ports: list[dict[str, Any]] = [
        {"port": port.name, "direction": port.direction, "message": port.message.__name__}
        for port in find_ports(class_).values()
    ]
    timers = [
        {"method": timer.method, "rate_parameter": timer.rate_parameter}
        for timer in find_timers(class_)
    ]
    parameters: list[dict[str, Any]] = [
        {"parameter": name, **describe_field(field)}
        for name, field in find_parameters_type(class_).model_fields.items()
    ]
    if found is not None:
        fields = {"node": node, "host": found.host, **fields}
        connected = {
            one.port: one.topic for one in (*found.inputs, *found.outputs) if one.endpoints
        }
        for port in ports:
            port["topic"] = connected.get(port["port"])
        for parameter in parameters:
            parameter["value"] = found.parameters.get(parameter["parameter"])
    if as_json:
        print_json({**fields, "ports": ports, "timers": timers, "parameters": parameters})
        return
    print_fields((name, value.split("\n")[0]) for name, value in fields.items())
    for rows in (ports, timers, parameters):
        if rows:
            print()
            print_rows(rows, as_json=False)
