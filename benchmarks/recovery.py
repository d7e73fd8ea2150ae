"""Measure the recovery of the graph after the triangulator is killed during a stroke.

python -m benchmarks.recovery [--rounds 3]

Starts `launch/demo.yaml` and kills the node with SIGKILL. From the bag it prints one line of JSON
per round: the time without fingertips, and the times after the last one at which the arms held,
stopped, and followed again.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import signal
import tempfile
from pathlib import Path
from typing import Any

from flexsheet.launch.experiments import stroke
from flexsheet.launch.experiments.driver import Driver
from flexsheet.launch.experiments.run import DEMO_FILE
from flexsheet.launch.plans.plan import load_graph
from flexsheet.launch.running.supervisor import RunningGraph
from flexsheet.messages.bag import BagReader
from flexsheet.messages.clock import SystemClock
from flexsheet.messages.types import ArmState, TwinFinger

STROKE_S = 8.0
KILLED = "triangulator"
AGAIN_S = 3.0


async def kill_during_stroke(bag: Path) -> int:
    """Kill the node during a stroke, and wait until it is restarted; return the time, ns."""
    plan = load_graph(DEMO_FILE, record=bag)
    scene = plan.scene_message()
    assert scene is not None
    async with RunningGraph(plan) as graph:
        await graph.wait_ready()
        async with Driver(plan, graph.run) as driver:
            await driver.wait_ready()
            driver.move_finger(stroke.stroke_path(scene, STROKE_S))

            def is_half_way() -> bool:
                finger = driver.newest("twin/finger")
                return isinstance(finger, TwinFinger) and finger.path_time_s > STROKE_S / 2

            await driver.wait_for(is_half_way, "the middle of the stroke", 3 * STROKE_S)
            killed_ns = SystemClock().now_ns()
            graph.kill(KILLED, signal.SIGKILL)
            await graph.wait_ready_again(KILLED, 1)
            # Long enough that the arms follow again and are recorded.
            await asyncio.sleep(AGAIN_S)
    return killed_ns


def compute_times(bag: Path, killed_ns: int) -> dict[str, Any]:
    """Return the recovery times of a bag, ms.

    killed_ns: time at which the node was killed, ns.
    """
    tips: list[int] = []
    arms: dict[str, list[tuple[int, str]]] = {"left": [], "right": []}
    for topic, message, header, _ in BagReader(bag, topics=["fingertip", "arm_left", "arm_right"]):
        if topic == "fingertip":
            tips.append(header.publish_ns)
        elif isinstance(message, ArmState):
            arms[message.side].append((header.publish_ns, message.mode))
    last_ns = max(stamp for stamp in tips if stamp <= killed_ns)
    first_ns = min(stamp for stamp in tips if stamp > killed_ns)
    result: dict[str, Any] = {"without_fingertip_ms": (first_ns - last_ns) * 1e-6}
    for side, states in arms.items():
        after = [(stamp, mode) for stamp, mode in states if stamp > last_ns]
        for name, modes in (("holds", ("hold",)), ("stops", ("stopping",)), ("rests", ("idle",))):
            stamps = [stamp for stamp, mode in after if mode in modes]
            result[f"{side}_{name}_ms"] = (stamps[0] - last_ns) * 1e-6 if stamps else None
        again = [stamp for stamp, mode in after if stamp > first_ns and mode == "follow"]
        result[f"{side}_follows_again_ms"] = (again[0] - last_ns) * 1e-6 if again else None
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--rounds", type=int, default=3)
    rounds = parser.parse_args().rounds
    for _ in range(rounds):
        with tempfile.TemporaryDirectory() as folder:
            bag = Path(folder) / "recovery.mcap"
            killed_ns = asyncio.run(kill_during_stroke(bag))
            print(json.dumps(compute_times(bag, killed_ns)), flush=True)


if __name__ == "__main__":
    main()
