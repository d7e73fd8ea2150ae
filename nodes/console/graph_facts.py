"""What the console has to know of the graph that it belongs to."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Self

RECORDER_TYPE = "recorder"


@dataclass(frozen=True, slots=True)
class GraphFacts:
    """Facts from the run's plan that hold as long as the console runs.

    others_may_reset: hosts that may reset an e-stop where the console's own may not; empty: it may.
    records: whether something records.  records_on_request: whether it waits to be asked to.
    """

    others_may_reset: tuple[str, ...] = ()
    records: bool = False
    records_on_request: bool = False

    @classmethod
    def from_plan(cls, plan_file: Path, console: str) -> Self:
        """Read the plan of the run.  console: name of the console's node."""
        plan = json.loads(plan_file.read_text())
        nodes, hosts = plan["nodes"], tuple(plan["estop_resetters"])
        recorders = [node for node in nodes.values() if node["type"] == RECORDER_TYPE]
        return cls(
            others_may_reset=() if nodes[console]["host"] in hosts else hosts,
            records=bool(recorders),
            records_on_request=any(one["parameters"]["start_paused"] for one in recorders),
        )
