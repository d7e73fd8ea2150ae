"""Check all hosts of a launch file or of the running graph for `flexsheet doctor`."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING

from flexsheet.launch.commands.graph import running_graph
from flexsheet.launch.commands.output import (
    CommandError,
    print_table,
    words,
)

if TYPE_CHECKING:
    from flexsheet.launch.health.doctor import Finding
    from flexsheet.launch.plans.plan_model import ResolvedGraph
    from flexsheet.launch.running.runs import Run

TIMEOUT_S = 4.0


def check_launch_file(launch_file: Path, host: str | None) -> list[Finding]:
    """Check this computer and the connections to all hosts of a launch file.

    If the graph is running, all its hosts are asked.

    host: name of this computer in the launch file; None determines it from its address.
    """
    plan, run = _find_graph(launch_file)
    here = find_host(plan, run, host)
    if run is not None and run.host not in (None, here):
        run = None
    words.print(f"{plan.launch_file}, plan {plan.hash}, checked from {here}")
    return asyncio.run(check_hosts(plan, here, run, TIMEOUT_S))


def check_running_graph() -> list[Finding]:
    """Check the hosts of the running graph; return an empty list if no graph is running.

    If the graph runs on one host, only the results of the nodes' own calibration checks are
    returned.
    """
    from flexsheet.launch.health.doctor_hosts import SELF_CHECK
    from flexsheet.launch.running.runs import list_live_runs
    from flexsheet.launch.running.tools import tools_host

    if not any(run.plan_file.is_file() for run in list_live_runs()):
        return []
    plan, run = running_graph(None)
    findings = asyncio.run(check_hosts(plan, tools_host(run), run, TIMEOUT_S))
    if len(plan.hosts) == 1:
        return [one for one in findings if one.check == SELF_CHECK]
    return findings


def _find_graph(launch_file: Path) -> tuple[ResolvedGraph, Run | None]:
    """Return the resolved graph of a launch file, and its run on this computer.

    A run is one execution of a graph. The result contains None instead of a run if the graph is not
    running.
    """
    from flexsheet.launch.plans.plan import load_graph

    plan = load_graph(launch_file)
    try:
        running, run = running_graph(None)
    except CommandError:
        return plan, None
    same = Path(running.launch_file).resolve() == launch_file.resolve()
    return plan, run if same or running.hash == plan.hash else None


def find_host(plan: ResolvedGraph, run: Run | None, requested: str | None) -> str:
    """Return the name of this computer among the hosts of a graph.

    requested: name that the user has given. It is None if the user has given no name.

    Raises CommandError if the name is unknown, or if the addresses of this computer do not
    determine its name.
    """
    from flexsheet.launch.health.doctor_hosts import list_own_addresses
    from flexsheet.launch.plans.documents import did_you_mean
    from flexsheet.launch.plans.plan_model import MAIN
    from flexsheet.launch.running.tools import tools_host

    if requested is not None:
        if requested not in plan.hosts:
            raise CommandError(
                f"--host {requested}: unknown host; {did_you_mean(requested, list(plan.hosts))}"
            )
        return requested
    if run is not None:
        return tools_host(run)
    own = list_own_addresses()
    found = [name for name, address in plan.hosts.items() if address in own]
    if MAIN in found or len(found) == 1:
        return MAIN if MAIN in found else found[0]
    raise CommandError(
        f"no address of this computer matches exactly one host in {plan.launch_file} "
        f"({', '.join(plan.hosts.values())}); name the host with --host NAME"
    )


async def check_hosts(
    plan: ResolvedGraph, here: str, run: Run | None, timeout_s: float
) -> list[Finding]:
    """Check this computer, and test the connections to all hosts of a graph; return all findings.

    here: host name of this computer.
    """
    import tempfile

    from flexsheet.launch.health.doctor_hosts import (
        check_before_start,
        evaluate_probes,
        find_key_problem,
    )
    from flexsheet.launch.health.probe import probe_all
    from flexsheet.launch.running.keys import secret_file
    from flexsheet.messages.security import KeyRing, write_ring

    key_problem = await asyncio.to_thread(find_key_problem, plan, here)
    with tempfile.TemporaryDirectory(prefix="flexsheet-") as folder:
        keys = None
        if plan.keys and key_problem is None:
            file = Path(folder) / "ring.json"
            write_ring(file, host=here, secret_file=secret_file(here), public=plan.keys)
            keys = KeyRing.load(file)
        probes = await probe_all(plan, here=here, keys=keys, run=run, timeout_s=timeout_s)
    findings = evaluate_probes(plan, here, probes)
    if probes[here].status is None:
        local = await asyncio.to_thread(lambda: list(check_before_start(plan, here, key_problem)))
        first = next((i for i, one in enumerate(findings) if one.host == here), 0)
        last = first + sum(one.host == here for one in findings)
        findings[last:last] = local
    return findings


def print_findings(findings: list[Finding]) -> None:
    """Print a table with one line per finding."""
    columns = ("host", "check", "state", "finding", "remedy")
    print_table(
        columns, [(one.host, one.check, one.state, one.what, one.remedy) for one in findings]
    )
