"""`flexsheet systemd`: run one host of a launch file under systemd."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flexsheet.launch.commands import complete
from flexsheet.launch.commands.graph import JsonOption
from flexsheet.launch.commands.output import BAD_INPUT, CommandError, examples, print_json, words
from flexsheet.messages.files import write_file

app = typer.Typer(add_completion=False, no_args_is_help=True)

USER_PATTERN = "abcdefghijklmnopqrstuvwxyz0123456789_-"


@app.callback()
def systemd() -> None:
    """Run one host of a launch file as a systemd service."""


@app.command(
    epilog=examples(
        "flexsheet systemd install /etc/flexsheet/lab.yaml --host arm_left --dry-run",
        "sudo flexsheet systemd install /etc/flexsheet/lab.yaml --host arm_left",
    )
)
def install(
    *,
    launch_file: Annotated[
        Path,
        typer.Argument(
            metavar="LAUNCH_FILE",
            help="The same on every host.",
            autocompletion=complete.yaml_files,
        ),
    ],
    host: Annotated[str, typer.Option(help="Which of its hosts this computer is.")],
    user: Annotated[str, typer.Option(help="Who runs it; must exist.")] = "flexsheet",
    root: Annotated[Path, typer.Option(help="Where the system lies.")] = Path("/"),
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print, write nothing.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Write flexsheet@.service, the host's environment and settings for TCP; start nothing."""
    from flexsheet.launch.plans.plan import load_graph
    from flexsheet.launch.running.systemd_unit import STATE, files_of, list_bags

    plan = load_graph(launch_file)
    if host not in plan.hosts:
        raise CommandError(
            f'{launch_file}: there is no host "{host}"; there are: {", ".join(plan.hosts)}',
            BAD_INPUT,
        )
    if not user or set(user) - set(USER_PATTERN):
        raise CommandError(f'--user "{user}" is no name of a user', BAD_INPUT)
    for bag in list_bags(plan, host):
        if not bag.is_relative_to(STATE):
            words.print(
                f"{bag} cannot be recorded: the service may write to {STATE} only; change the "
                "launch file",
                markup=False, style="yellow",
            )  # fmt: skip
    files = list(files_of(launch_file=launch_file, host=host, user=user, root=root))
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
                f"{file.path}: cannot be written: {error.strerror}; as root?"
            ) from error
        words.print(f"wrote {file.path}", markup=False)
    if not dry_run:
        words.print(
            f"next: sysctl -e -p /etc/sysctl.d/90-flexsheet.conf && systemctl daemon-reload && "
            f"systemctl enable --now flexsheet@{host}; "
            f"its words: journalctl -fu flexsheet@{host}",
            markup=False,
        )
