"""`flexsheet doctor`: is this machine fit, and if not, what is to be done."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from launch.commands.graph import JsonOption
from launch.commands.output import FAILED, print_json, print_table, words


def doctor(
    sweep: Annotated[
        bool, typer.Option("--sweep", help="First end what launchers that are gone left running.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Check this machine; exit code 1 when something must be put right."""
    from launch.doctor import check_all
    from launch.runs import sweep as sweep_leftovers

    if sweep:
        ended = sweep_leftovers()
        words.print(f"ended {len(ended)} left-over processes")
    findings = []
    with words.status("checking") as status:
        for finding in check_all():
            status.update(f"checked {finding.check}")
            findings.append(finding)
    if as_json:
        print_json([asdict(finding) for finding in findings])
    else:
        print_table(
            ("check", "state", "what", "what to do"),
            [(one.check, one.state, one.what, one.remedy) for one in findings],
        )
    if any(finding.state == "failed" for finding in findings):
        raise typer.Exit(FAILED)
