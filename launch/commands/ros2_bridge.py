"""`flexsheet ros2-bridge`: connect the running graph to ROS 2."""

from __future__ import annotations

import asyncio
import os
from collections import Counter
from typing import TYPE_CHECKING, Annotated

import typer

from flexsheet.launch.commands import options
from flexsheet.launch.commands.graph import run_interruptible, running_graph
from flexsheet.launch.commands.output import CommandError, examples, print_json, words

if TYPE_CHECKING:
    from flexsheet.launch.plans.plan_model import ResolvedGraph
    from flexsheet.launch.ros2.dds import RosParticipant
    from flexsheet.launch.running.runs import Run

app = options.make_app()


@app.command(
    epilog=examples(
        "flexsheet ros2-bridge",
        "flexsheet ros2-bridge --topic fingertip --topic arm_left --topic arm_right",
    )
)
def ros2_bridge(
    *,
    topics: options.TopicsOption = None,
    interface: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Network interface. DDS has no authentication here: on any interface except lo, "
            "everyone in that network can read the topics.",
        ),
    ] = "lo",
    duration: options.DurationOption = None,
    run: options.RunOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Publish the topics of the running graph to ROS 2, until Ctrl-C.

    RViz can then show the arms, the sheet and the fingertip, and `ros2 bag record` can record them.
    ROS nodes cannot publish in the graph. By default the bridge uses the loopback interface. The
    environment variable ROS_DOMAIN_ID sets the DDS domain.
    """
    from flexsheet.launch.ros2.bridge import list_default_topics
    from flexsheet.launch.ros2.dds import MAX_DOMAIN, RosParticipant
    from flexsheet.messages.topics import find_topic

    plan, found = running_graph(run)
    names = topics or list_default_topics(plan)
    for name in names:
        find_topic(name)
        if name not in plan.writers:
            raise CommandError(
                f"--topic {name}: the topic has no writer in the running graph; "
                "`flexsheet topic list` lists its topics"
            )
    domain = os.environ.get("ROS_DOMAIN_ID", "0")
    if not domain.isdigit() or int(domain) > MAX_DOMAIN:
        raise CommandError(
            f"ROS_DOMAIN_ID={domain}: expected a number from 0 to {MAX_DOMAIN}; correct it"
        )
    participant = RosParticipant(int(domain), interface)
    words.print(f"ROS domain {domain} on {interface}; press Ctrl-C to stop")
    published: Counter[str] = Counter()
    run_interruptible(
        _run(plan, found, participant, names, duration_s=duration, published=published)
    )
    if as_json:
        print_json({"published": published})
        return
    listed = ", ".join(f"{number} {name}" for name, number in sorted(published.items()))
    words.print(f"published: {listed or 'none'}")


async def _run(
    plan: ResolvedGraph,
    run: Run,
    participant: RosParticipant,
    topics: list[str],
    *,
    duration_s: float | None,
    published: Counter[str],
) -> int:
    """Bridge a graph for a duration (None: until Ctrl-C); always return 0, the exit code.

    published: counter to which the numbers of messages by ROS topic are added.
    """
    from flexsheet.launch.ros2.bridge import Ros2Bridge

    bridge = Ros2Bridge(plan, run, participant, topics=topics, on_problem=words.print)
    try:
        bridge.start()
        async with asyncio.timeout(duration_s):
            await asyncio.Event().wait()
    except TimeoutError:
        pass
    finally:
        bridge.close()
        published.update(bridge.published)
    return 0
