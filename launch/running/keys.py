"""Manage the key pairs with which the hosts of a graph authenticate each other.

The secret key of a host is stored in `directory()`, in a file with the host's name. The public key
of a host is the value of `hosts.NAME.key` in the launch file. A key ring file in the run's
directory contains the keys that the processes of a host need.
"""

from __future__ import annotations

import os
from io import StringIO
from pathlib import Path

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap
from ruamel.yaml.scalarstring import SingleQuotedScalarString

from flexsheet.launch.plans.documents import BadInputError, Problem, did_you_mean, read_document
from flexsheet.launch.plans.plan_model import ResolvedGraph
from flexsheet.launch.running.runs import Run, ring_file
from flexsheet.messages.files import write_file
from flexsheet.messages.security import KeyRing, SecurityError, is_key, write_ring

KEYS_VARIABLE = "FLEXSHEET_KEYS"
"""The environment variable that replaces the default folder of secret keys."""


def directory() -> Path:
    """Return the folder of this user's secret keys."""
    configured = os.environ.get(KEYS_VARIABLE)
    if configured:
        return Path(configured)
    return Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "flexsheet" / "keys"


def secret_file(host: str) -> Path:
    """Return the path of the file with the secret key of a host."""
    return directory() / f"{host}.secret"


def make_rings(plan: ResolvedGraph, run: Run, host: str | None) -> dict[str, KeyRing]:
    """Write the key ring files of a run, load them, and return the key rings by host.

    host: host whose key ring file is written. If it is None, the files of all hosts are written.

    Raises BadInputError if a key is missing or invalid.
    """
    rings = {}
    problems = []
    for name in plan.hosts if host is None else [host]:
        file = ring_file(run, name)
        write_ring(file, host=name, secret_file=secret_file(name), public=plan.keys)
        try:
            rings[name] = KeyRing.load(file)
        except SecurityError as error:
            problems.append(Problem(plan.launch_file, ("hosts", name, "key"), str(error)))
    if problems:
        raise BadInputError(problems)
    return rings


def install(launch_file: Path, host: str, key: str) -> None:
    """Write the public key of a host into a launch file.

    Raises BadInputError if the launch file does not contain the host, or if the key is invalid.
    """
    document = read_document(launch_file)
    if not isinstance(document.find(("hosts", host)), dict):
        hosts = document.find(("hosts",))
        names = list(hosts) if isinstance(hosts, dict) else []
        raise document.error(("hosts",), f'there is no host "{host}"', did_you_mean(host, names))
    if not is_key(key):
        raise BadInputError.single(
            "KEY",
            (),
            f'"{key}" is not a public key',
            f"give the 40 characters that `flexsheet keys {host}` prints on that host",
        )
    yaml = YAML(typ="rt")
    yaml.preserve_quotes = True
    yaml.width = 1 << 16
    tree: CommentedMap = yaml.load(document.text)
    # The key is quoted, because an unquoted value that begins with "?" is not valid YAML.
    tree["hosts"][host]["key"] = SingleQuotedScalarString(key)
    text = StringIO()
    yaml.dump(tree, text)
    write_file(launch_file, text.getvalue(), mode=launch_file.stat().st_mode & 0o777)
