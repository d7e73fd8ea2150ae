"""`flexsheet param`: get and set the parameters of the nodes of the running graph."""

from __future__ import annotations

import asyncio
import json
from contextlib import closing
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flexsheet.launch.commands.graph import (
    choose_run,
    find_node,
    receive_until,
    run_interruptible,
    running_graph,
)
from flexsheet.launch.commands.options import ChangedRunOption, JsonOption, RunOption, make_app
from flexsheet.launch.commands.output import (
    FAILED,
    CommandError,
    examples,
    print_json,
    print_outcome,
    print_rows,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from flexsheet.launch.plans.plan_model import ResolvedGraph, ResolvedNode
    from flexsheet.launch.running.runs import Run
    from flexsheet.messages.types import Status

app = make_app("Get and set parameters of the running graph.")

STATUS_TIMEOUT_S = 3.0
"""The maximum time to wait for the statuses of nodes, in seconds.

A status contains the changed parameters of a node and is published once a second.
"""


@app.command(
    "get",
    epilog=examples(
        "flexsheet param get",
        "flexsheet param get fem_solver",
        "flexsheet param get fem_solver.prediction_horizon_s",
    ),
)
def get_parameters(
    given: Annotated[
        str | None,
        typer.Argument(
            metavar="NODE.PARAM",
            help="Node, or node and parameter, separated by a dot; default: all nodes.",
        ),
    ] = None,
    run: RunOption = None,
    as_json: JsonOption = False,
) -> None:
    """Print the value of a parameter of the running graph, or a table of all parameters.

    The table states which parameters can be changed while the graph runs.
    """
    plan, found = running_graph(run)
    if given is None:
        nodes = list(plan.nodes.values())
    elif "." in given:
        node, name = _find_parameter(plan, given)
        nodes = [node.model_copy(update={"parameters": {name: node.parameters[name]}})]
    else:
        nodes = [find_node(plan, given)]
    live = {one.name: _find_live(one) for one in nodes}
    wanted = {name for name, names in live.items() if names is None or names}
    changed: dict[str, dict[str, Any]] = {}
    if wanted:
        run_interruptible(_receive_changes(plan, found, changed, lambda: wanted <= changed.keys()))
    rows = [
        {
            "parameter": f"{one.name}.{name}",
            "value": changed.get(one.name, {}).get(name, value),
            "live": None if (names := live[one.name]) is None else name in names,
        }
        for one in nodes
        for name, value in one.parameters.items()
        if name != "apparatus"
    ]
    if as_json:
        print_json(rows)
    elif given is not None and "." in given:
        print(json.dumps(rows[0]["value"]))
    else:
        print_rows([{**row, "value": json.dumps(row["value"])} for row in rows], as_json=False)


@app.command(
    "set",
    epilog=examples("flexsheet param set fem_solver.prediction_horizon_s 0.02"),
    context_settings={"ignore_unknown_options": True},
)
def set_parameter(
    parameter: Annotated[
        str,
        typer.Argument(
            metavar="NODE.PARAM",
            help="Node and parameter, separated by a dot, such as planner.max_age_s.",
        ),
    ],
    value: Annotated[str, typer.Argument(help="New value, in YAML syntax.")],
    run: ChangedRunOption = None,
    as_json: JsonOption = False,
) -> None:
    """Change a parameter of a running node; the change is lost when the node restarts.

    `flexsheet param get` shows which parameters can be changed while the graph runs.
    """
    from pydantic import ValidationError
    from ruamel.yaml.error import YAMLError

    from flexsheet.launch.plans.documents import describe_value_error, parse_value
    from flexsheet.launch.running.tools import READER_RECONNECT_S, GraphWriter
    from flexsheet.messages.types import ParameterChange
    from flexsheet.nodes import node_class
    from flexsheet.nodes.node import find_parameters_type

    plan, found = running_graph(choose_run(run))
    node, name = _find_parameter(plan, parameter)
    names = node_class(node.type).live_parameters
    if name not in names:
        live = ", ".join(f"{node.name}.{one}" for one in sorted(names)) or "none"
        raise CommandError(
            f"{parameter}: this parameter cannot change while the node runs; start the graph again "
            f"with --set {parameter}={value} (parameters that can change: {live})"
        )
    try:
        parsed = parse_value(value)
        kind = find_parameters_type(node_class(node.type))
        checked = kind.model_validate({**node.parameters, name: parsed})
    except YAMLError as error:
        raise CommandError(f"VALUE {value}: not a valid YAML value: {error}") from error
    except ValidationError as error:
        texts = ("; ".join(describe_value_error(one, name)) for one in error.errors())
        raise CommandError(f"{parameter}: {', '.join(texts)}") from error
    new = checked.model_dump(mode="json")[name]
    change = ParameterChange(node=node.name, parameter=name, value=json.dumps(new))
    changed: dict[str, dict[str, Any]] = {}

    async def publish() -> int:
        with closing(GraphWriter(plan, found, ["parameter"])) as writer:
            await asyncio.sleep(READER_RECONNECT_S)
            writer.publish("parameter", change)
            return await _receive_changes(
                plan, found, changed, lambda: changed.get(node.name, {}).get(name) == new
            )

    if run_interruptible(publish()):
        raise CommandError(
            f"{parameter}: the node did not confirm the change; see flexsheet logs {node.name}",
            FAILED,
        )
    result = {"parameter": parameter, "value": new}
    print_outcome(result, f"{parameter} = {json.dumps(new)}", as_json=as_json)


def _find_parameter(plan: ResolvedGraph, text: str) -> tuple[ResolvedNode, str]:
    from flexsheet.launch.plans.documents import did_you_mean

    node_name, dot, name = text.partition(".")
    if not dot:
        raise CommandError(f'"{text}": the node is missing; write NODE.PARAMETER')
    node = find_node(plan, node_name)
    if name not in node.parameters:
        raise CommandError(
            f'"{text}": unknown parameter; {did_you_mean(name, list(node.parameters))}'
        )
    return node, name


def _find_live(node: ResolvedNode) -> frozenset[str] | None:
    """Return the parameters that can change while the node runs.

    Returns None if the class of the node cannot be imported here.
    """
    from flexsheet.nodes import NodeImportError, node_class

    try:
        return node_class(node.type).live_parameters
    except NodeImportError:
        return None


async def _receive_changes(
    plan: ResolvedGraph,
    run: Run,
    changed: dict[str, dict[str, Any]],
    done: Callable[[], bool],
) -> int:
    """Receive statuses of nodes until `done` returns True; return 0, or 1 on a timeout.

    changed: mapping to which the changed parameters are added, by node name and parameter name.
    """

    def add(status: Status) -> None:
        changed[status.node] = json.loads(status.changed_parameters)

    return int(not await receive_until(plan, run, {"status": add}, done, STATUS_TIMEOUT_S))
