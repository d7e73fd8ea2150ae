"""Run several nodes in a process as one computer: `python -m tests.arm_computer CONFIG...`.

Each argument is a `NodeConfig` as JSON. The process ends with SIGTERM.
"""

from __future__ import annotations

import asyncio
import math
import signal
import sys

import numpy as np

from flexsheet.messages.scene import Scene
from flexsheet.messages.types import SheetTarget
from flexsheet.nodes.models.rigid import transform_from_rpy
from flexsheet.nodes.node import Node, NodeParameters, Output, periodic
from flexsheet.nodes.runner import NodeConfig, run_node
from tests.scenes import load_cylinder

LEAN_RAD, PERIOD_S = 0.3, 4.0


class StrokerParameters(NodeParameters):
    rate_hz: float = 60.0


class Stroker(Node):
    """Substitute for the planner: a sheet that tilts back and forth endlessly."""

    parameters: StrokerParameters
    scene: Output[Scene]
    sheet_target: Output[SheetTarget]

    async def setup(self) -> None:
        self._scene = load_cylinder()
        self._reported = False

    @periodic("rate_hz")
    def stroke(self) -> None:
        if not self._reported:
            self.scene.publish(self._scene)
            self._reported = True
        now_ns = self.clock.now_ns()
        phase = 2.0 * math.pi * now_ns * 1e-9 / PERIOD_S
        rate = LEAN_RAD * 2.0 * math.pi / PERIOD_S * math.cos(phase)
        self.sheet_target.publish(
            SheetTarget(
                phase="contact",
                reason="ok",
                valid_at_ns=now_ns,
                world_from_sheet=transform_from_rpy(
                    np.zeros(3), [LEAN_RAD * math.sin(phase), 0.0, 0.0]
                ),
                twist_world=np.array([0.0, 0.0, 0.0, rate, 0.0, 0.0]),
                stretch_ratio=1.04,
                contact_world_m=np.zeros(3),
                normal_world=np.array([0.0, 0.0, 1.0]),
                contact_sheet_m=np.zeros(2),
                push_depth_m=0.0,
            )
        )


async def main(texts: list[str]) -> None:
    stop = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stop.set)
    await asyncio.gather(*(run_node(NodeConfig.model_validate_json(text), stop) for text in texts))


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1:]))
