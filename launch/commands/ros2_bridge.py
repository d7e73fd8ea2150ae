"""`flexsheet ros2-bridge`: connect the running graph to ROS 2."""

from __future__ import annotations

import asyncio
import os
from typing import Annotated

import typer

from flexsheet.launch.commands import options
from flexsheet.launch.commands.graph import run_interruptible, running_graph
from flexsheet.launch.commands.output import CommandError, examples, print_outcome, words

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
    from flexsheet.launch.ros2.bridge import Ros2Bridge, list_default_topics
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
    published: dict[str, int] = {}

    async def bridge_topics() -> int:
        bridge = Ros2Bridge(plan, found, participant, topics=names, on_problem=words.print)
        try:
            bridge.start()
            async with asyncio.timeout(duration):
                await asyncio.Event().wait()
        except TimeoutError:
            pass
        finally:
            bridge.close()
            published.update(bridge.published)
        return 0

    run_interruptible(bridge_topics())
    listed = ", ".join(f"{number} {name}" for name, number in sorted(published.items()))
    print_outcome({"published": published}, f"published: {listed or 'none'}", as_json=as_json)
