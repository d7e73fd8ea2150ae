"""`flexsheet systemd`: run the nodes of one host of a launch file as a systemd service."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from flexsheet.launch.commands.options import JsonOption, LaunchArgument
from flexsheet.launch.commands.output import FAILED, CommandError, examples, print_json, words
from flexsheet.messages.files import write_file

app = typer.Typer(add_completion=False, no_args_is_help=True)


@app.callback()
def systemd() -> None:
    """Run the nodes of one host of a launch file as a systemd service."""


@app.command(
    epilog=examples(
        "flexsheet systemd install /etc/flexsheet/lab.yaml --host left --dry-run",
        "sudo flexsheet systemd install /etc/flexsheet/lab.yaml --host left",
    )
)
def install(
    *,
    launch_file: LaunchArgument,
    host: Annotated[
        str, typer.Option(metavar="HOST", help="Host name of this computer in the launch file.")
    ],
    user: Annotated[
        str, typer.Option(metavar="USER", help="Existing user account that runs the service.")
    ] = "flexsheet",
    root: Annotated[
        Path, typer.Option(metavar="FOLDER", help="Root folder below which the files are written.")
    ] = Path("/"),
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the files instead of writing them.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Install the systemd unit flexsheet@.service, its environment file, and kernel TCP settings.

    The command does not start the service, but prints the commands with which you can start it.
    """
    from flexsheet.launch.plans.plan import load_graph
    from flexsheet.launch.running.systemd import STATE_FOLDER, list_bags, make_files

    plan = load_graph(launch_file)
    if host not in plan.hosts:
        raise CommandError(
            f'--host "{host}": unknown host; {launch_file} defines {", ".join(plan.hosts)}'
        )
    if not re.fullmatch(r"[a-z0-9_-]+", user):
        raise CommandError(
            f'--user "{user}": invalid user name; use lower-case letters, digits, _ and -'
        )
    for bag in list_bags(plan, host):
        if not bag.is_relative_to(STATE_FOLDER):
            words.print(
                f"{bag}: the service can write only to {STATE_FOLDER}; change the path of the bag "
                "in the launch file",
                style="yellow",
            )
    files = list(make_files(launch_file=launch_file, host=host, user=user, root=root))
    if as_json:
        print_json([{"path": str(file.path), "text": file.text} for file in files])
    for file in files:
        if dry_run:
            if not as_json:
                print(f"# {file.path}\n{file.text}")
            continue
        try:
            file.path.parent.mkdir(parents=True, exist_ok=True)
            write_file(file.path, file.text, mode=file.mode)
        except OSError as error:
            raise CommandError(
                f"{file.path}: cannot be written: {error.strerror}; run the command as root", FAILED
            ) from error
        words.print(f"wrote {file.path}")
    if not dry_run:
        words.print(
            f"next: sysctl -e -p /etc/sysctl.d/90-flexsheet.conf && systemctl daemon-reload && "
            f"systemctl enable --now flexsheet@{host}; log: journalctl -fu flexsheet@{host}"
        )
