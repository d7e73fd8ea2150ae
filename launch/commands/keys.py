"""`flexsheet keys`: manage the key pairs by which the hosts of a graph authenticate each other."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from flexsheet.launch.commands.options import JsonOption, LaunchArgument, make_app
from flexsheet.launch.commands.output import (
    CommandError,
    examples,
    print_json,
    print_outcome,
    words,
)

KEY_LENGTH = 40

app = make_app("Manage the key pairs by which hosts authenticate each other.")


class KeyCommand(TyperCommand):
    """A command whose last argument can be a public key that starts with "-"."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert "--" before a key that starts with "-", so that it is not parsed as an option."""
        keys = [one for one in args if one.startswith("-") and len(one) == KEY_LENGTH]
        if keys and "--" not in args:
            args = [one for one in args if one not in keys] + ["--", *keys]
        return super().parse_args(ctx, args)


HostArgument = Annotated[
    str, typer.Argument(metavar="HOST", help="Name of the host in the launch file.")
]


@app.command(epilog=examples("flexsheet keys new left"))
def new(
    host: HostArgument,
    replace: Annotated[
        bool,
        typer.Option(
            "--replace", help="Overwrite an existing key of the host; it cannot be restored."
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Create the key pair of this computer if there is none, and print the public key.

    Run the command on the host itself. The secret key is stored in a file that only you can read.
    """
    import re

    from flexsheet.launch.running.keys import secret_file
    from flexsheet.messages.security import (
        derive_public_key,
        make_key_pair,
        read_secret,
        write_secret,
    )

    if not re.fullmatch(r"[a-z][a-z0-9_]{0,31}", host):
        raise CommandError(f'"{host}": invalid host name; use lower-case letters, digits and _')
    file = secret_file(host)
    if file.exists() and not replace:
        public = derive_public_key(read_secret(file))
    else:
        public, secret = make_key_pair()
        write_secret(file, secret, replace=replace)
    words.print(f"secret key: {file}; do not copy it to another computer")
    words.print(f"run on every computer: flexsheet keys install LAUNCH_FILE {host} '{public}'")
    if as_json:
        print_json({"host": host, "public": public, "secret_file": str(file)})
    else:
        print(public)


@app.command(
    cls=KeyCommand,
    epilog=examples(
        "flexsheet keys install launch/lab.yaml left 'rq:rM>}U?@Lns47E1%kR.o@n%FcmmsL/@{H8]yf7'"
    ),
)
def install(
    launch_file: LaunchArgument,
    host: HostArgument,
    key: Annotated[
        str | None, typer.Argument(help="Public key; default: key of HOST stored on this computer.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write a host's public key into a launch file.

    A running graph of this launch file uses the new key within two seconds, without a restart.
    """
    from flexsheet.launch.running.keys import install as install_key
    from flexsheet.launch.running.keys import secret_file
    from flexsheet.messages.security import derive_public_key, read_secret

    if key is None:
        key = derive_public_key(read_secret(secret_file(host)))
    install_key(launch_file, host, key)
    print_outcome(
        {"launch_file": str(launch_file), "host": host, "public": key},
        f"{launch_file}: hosts.{host}.key = {key}",
        as_json=as_json,
    )
