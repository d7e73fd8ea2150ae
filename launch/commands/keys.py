"""`flexsheet keys`: manage the key pairs by which the hosts of a graph authenticate each other."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flexsheet.launch.commands.options import LAUNCH_FILE, JsonOption, make_app
from flexsheet.launch.commands.output import CommandError, examples, print_json, words

app = make_app()


@app.command(
    epilog=examples(
        "flexsheet keys left",
        "flexsheet keys left --install launch/lab.yaml",
        "flexsheet keys left --install launch/lab.yaml "
        "--key 'rq:rM>}U?@Lns47E1%kR.o@n%FcmmsL/@{H8]yf7'",
    )
)
def keys(
    *,
    host: Annotated[str, typer.Argument(help="Name of the host in the launch file.")],
    replace: Annotated[
        bool,
        typer.Option(
            "--replace", help="Overwrite an existing key of the host; it cannot be restored."
        ),
    ] = False,
    install: Annotated[
        Path | None,
        typer.Option("--install", help="Launch file to write the public key into.", **LAUNCH_FILE),
    ] = None,
    key: Annotated[
        str | None,
        typer.Option(metavar="KEY", help="With --install: public key of another computer."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Print the public key of this computer as HOST, and create the key pair if there is none.

    The secret key is stored in a file that only you can read.
    """
    import re

    from flexsheet.launch.running.keys import install as install_key
    from flexsheet.launch.running.keys import secret_file
    from flexsheet.messages.security import (
        derive_public_key,
        make_key_pair,
        read_secret,
        write_secret,
    )

    if not re.fullmatch(r"[a-z][a-z0-9_]{0,31}", host):
        raise CommandError(f'"{host}": invalid host name; use lower-case letters, digits and _')
    if key is not None and (install is None or replace):
        raise CommandError("--key requires --install, and excludes --replace")
    file = secret_file(host)
    if key is not None:
        public = key
    elif file.exists() and not replace:
        public = derive_public_key(read_secret(file))
    else:
        public, secret = make_key_pair()
        write_secret(file, secret, replace=replace)
        words.print(f"secret key: {file}; do not copy it to another computer")
    if install is not None:
        install_key(install, host, public)
        words.print(f"{install}: hosts.{host}.key = {public}")
    if as_json:
        print_json({"host": host, "public": public, "secret_file": str(file)})
    else:
        print(public)
