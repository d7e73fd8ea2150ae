"""Read properties of the node graph from the plan file of a run.

The console needs these properties. They are constant during a run.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from flexsheet.messages.topics import TOPICS
from flexsheet.messages.types import Skin
from flexsheet.nodes import NodeRole


@dataclass(frozen=True, slots=True)
class GraphFacts:
    """The properties of the graph that are constant while the console runs.

    others_may_reset: hosts that may reset an e-stop if the console's own host may not; otherwise
        empty.
    recorders: names of the recorder nodes.
    records_on_request: whether a recorder waits for a message on the topic `recording`.
    solvers: names of the nodes that publish the surface mesh of the soft object.
    simulates_finger: whether the finger is simulated, so that viewers can move it.
    """

    others_may_reset: tuple[str, ...] = ()
    recorders: tuple[str, ...] = ()
    records_on_request: bool = False
    solvers: tuple[str, ...] = ()
    simulates_finger: bool = False

    @classmethod
    def from_plan(cls, plan_file: Path, console: str) -> Self:
        """Read the properties of the graph from the plan of the run.

        console: name of the console's node.
        """
        plan = json.loads(plan_file.read_text())
        nodes, hosts = plan["nodes"], tuple(plan["estop_resetters"])
        skins = {name for name, topic in TOPICS.items() if topic.message is Skin}
        recorders = _with_role(nodes, NodeRole.RECORDER)
        return cls(
            others_may_reset=() if nodes[console]["host"] in hosts else hosts,
            recorders=recorders,
            records_on_request=any(nodes[name]["parameters"]["start_paused"] for name in recorders),
            solvers=tuple(
                name
                for name, node in nodes.items()
                if any(port["topic"] in skins for port in node["outputs"])
            ),
            simulates_finger=bool(_with_role(nodes, NodeRole.FINGER_SIMULATOR)),
        )


def _with_role(nodes: dict[str, Any], role: NodeRole) -> tuple[str, ...]:
    return tuple(name for name, node in nodes.items() if node["role"] == role)
