"""`flexsheet ros2-bridge`: connect the running graph to ROS 2."""

from __future__ import annotations

import asyncio
import os
from enum import StrEnum
from typing import Annotated, Any

import typer

from flexsheet.launch.commands import options
from flexsheet.launch.commands.graph import run_interruptible, running_graph
from flexsheet.launch.commands.output import CommandError, examples, print_json, words

app = options.make_app()


class ExternalTopic(StrEnum):
    """The flexsheet topics that ROS nodes may publish if the user permits this."""

    EYE = "eye"
    FINGERTIP = "fingertip"


@app.command(
    epilog=examples(
        "flexsheet ros2-bridge",
        "flexsheet ros2-bridge --topic fingertip --topic arm_left --topic arm_right",
        "flexsheet ros2-bridge --accept eye --domain 5",
    )
)
def ros2_bridge(
    *,
    topics: options.TopicsOption = None,
    accept: Annotated[
        list[ExternalTopic] | None,
        typer.Option(
            help="Topic that ROS nodes may publish, as /external/eye or /external/fingertip; can "
            "be repeated; default: none."
        ),
    ] = None,
    noise_mm: Annotated[
        float,
        typer.Option(
            metavar="MM",
            min=0.01,
            max=50.0,
            help="Standard deviation of external fingertip positions, mm.",
        ),
    ] = 1.0,
    domain: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=232,
            help="DDS domain number; default: value of the environment variable ROS_DOMAIN_ID, or "
            "0 if it is not set.",
        ),
    ] = None,
    interface: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Network interface. DDS has no authentication here: on any interface except lo, "
            "everyone in that network can read the topics and publish external inputs.",
        ),
    ] = "lo",
    duration: options.DurationOption = None,
    run: options.RunOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Publish the topics of the running graph to ROS 2, and accept external inputs.

    RViz can then show the arms, the sheet and the fingertip, and `ros2 bag record` can record them.
    The bridge never commands the arms. By default it uses the loopback interface.
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
    if domain is None:
        given = os.environ.get("ROS_DOMAIN_ID", "0")
        if not given.isdigit() or int(given) > MAX_DOMAIN:
            raise CommandError(
                f"ROS_DOMAIN_ID={given}: expected a number from 0 to {MAX_DOMAIN}; correct it, or "
                "give --domain"
            )
        domain = int(given)
    participant = RosParticipant(domain, interface)
    settings = {
        "topics": names,
        "accept": [one.value for one in accept or ()],
        "noise_m": noise_mm * 1e-3,
    }
    words.print(f"ROS domain {domain} on {interface}; press Ctrl-C to stop")
    counts: dict[str, Any] = {"published": {}, "accepted": {}, "rejected": {}}
    work = _run(plan, found, participant, options=settings, duration_s=duration, counts=counts)
    run_interruptible(work)
    if as_json:
        print_json(counts)
        return
    for what, numbers in counts.items():
        listed = ", ".join(f"{number} {name}" for name, number in sorted(numbers.items()))
        words.print(f"{what}: {listed or 'none'}")


async def _run(
    plan: Any,
    run: Any,
    participant: Any,
    *,
    options: dict[str, Any],
    duration_s: float | None,
    counts: dict[str, Any],
) -> int:
    from flexsheet.launch.ros2.bridge import Ros2Bridge

    try:
        bridge = Ros2Bridge(
            plan,
            run,
            participant,
            **options,
            on_problem=words.print,
        )
    except BaseException:
        participant.close()
        raise
    try:
        bridge.start()
        async with asyncio.timeout(duration_s):
            await asyncio.Event().wait()
    except TimeoutError:
        pass
    finally:
        bridge.close()
        counts["published"] = dict(bridge.published)
        counts["accepted"] = dict(bridge.accepted)
        counts["rejected"] = {str(key): value for key, value in bridge.inputs.rejected.items()}
    return 0
