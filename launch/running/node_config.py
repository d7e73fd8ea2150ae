"""Make the configuration of a node from the plan of a graph and the directory of a run."""

from __future__ import annotations

from typing import Any

from flexsheet.launch.plans.hosts import clock_node
from flexsheet.launch.plans.plan_model import RUN_DIRECTORY, ResolvedGraph, ResolvedNode
from flexsheet.launch.running.runs import Run, local_endpoints, local_sources, ring_file
from flexsheet.nodes.runner import NodeConfig, PortConfig


def node_config(plan: ResolvedGraph, node: ResolvedNode, run: Run) -> NodeConfig:
    """Return the configuration of a node in a run.

    In the endpoints and parameters, the placeholder of the run's directory is replaced by its path.
    """
    inputs = []
    for port in node.inputs:
        sources = plan.sources_to_read(port.topic, node.host)
        connected = [source for source in sources if source.endpoint in port.endpoints]
        endpoints = local_sources(run, connected)
        inputs.append(PortConfig(port=port.port, topic=port.topic, endpoints=endpoints))
    outputs = [
        PortConfig(port=one.port, topic=one.topic, endpoints=local_endpoints(run, one.endpoints))
        for one in node.outputs
    ]
    clocks = plan.writer("clocks", clock_node(node.host))
    return NodeConfig(
        name=node.name,
        type=node.type,
        parameters=_fill_run(node.parameters, run),
        inputs=tuple(inputs),
        outputs=tuple(outputs),
        plan_hash=plan.hash,
        run_dir=str(run.directory),
        keys_file=ring_file(run, node.host) if plan.keys else None,
        estop_resetters=plan.may_reset_estop(),
        clocks=None
        if clocks is None
        else PortConfig(
            port="clocks",
            topic="clocks",
            endpoints=local_sources(run, [clocks.source_for(node.host)]),
        ),
    )


def _fill_run(value: Any, run: Run) -> Any:
    if isinstance(value, str) and value.startswith(f"{RUN_DIRECTORY}/"):
        return str(run.directory / value.removeprefix(f"{RUN_DIRECTORY}/"))
    if isinstance(value, dict):
        return {key: _fill_run(item, run) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_fill_run(item, run) for item in value]
    return value
