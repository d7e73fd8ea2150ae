"""The hosts of a launch file: their addresses and keys, each a good one, each of one host."""

from __future__ import annotations

import ipaddress
from pathlib import Path

from flexsheet.launch.plans.documents import (
    BadInputError,
    Document,
    Key,
    Problem,
    read_document,
    validate,
)
from flexsheet.launch.plans.launch_file import HostSpec, LaunchFile
from flexsheet.launch.plans.plan_model import LAUNCHER, MAIN
from flexsheet.messages.security import is_key


def check_hosts(hosts: dict[str, HostSpec], document: Document, problems: list[Problem]) -> None:
    """Addresses and keys: each a good one, each of one host."""
    if MAIN not in hosts:
        problems.append(
            document.problem(
                ("hosts",), f'no host is named "{MAIN}"', "the launcher and the tools need it"
            )
        )
    _check_keys(hosts, document, problems)
    seen: dict[str, str] = {}
    for name, host in hosts.items():
        key: Key = ("hosts", name, "address")
        try:
            address = ipaddress.ip_address(host.address)
        except ValueError:
            problems.append(
                document.problem(key, f'"{host.address}" is no IP address', 'as in "192.0.2.10"')
            )
            continue
        if address.is_unspecified or address.is_multicast:
            problems.append(
                document.problem(
                    key, f'"{host.address}" names no single host', "give the address of its own"
                )
            )
        other = seen.setdefault(host.address, name)
        if other != name:
            problems.append(
                document.problem(
                    key, f'"{host.address}" is the address of host "{other}" too', "make them one"
                )
            )


def _check_keys(hosts: dict[str, HostSpec], document: Document, problems: list[Problem]) -> None:
    seen: dict[str, str] = {}
    for name, host in hosts.items():
        where: Key = ("hosts", name, "key")
        if host.key is None:
            if any(other.key is not None for other in hosts.values()):
                problems.append(
                    document.problem(
                        ("hosts", name),
                        "has no key, others have",
                        f"make one there (flexsheet keys new {name}), then: "
                        f"flexsheet keys install FILE {name} KEY",
                    )
                )
        elif not is_key(host.key):
            problems.append(
                document.problem(
                    where,
                    f'"{host.key}" is no public key',
                    f"40 characters, as this prints: flexsheet keys show {name}",
                )
            )
        elif seen.setdefault(host.key, name) != name:
            problems.append(
                document.problem(
                    where, f'is the key of host "{seen[host.key]}" too', "each host has its own"
                )
            )


def load_keys(path: Path) -> dict[str, str]:
    """The public key of each host in a launch file, which may have changed since it was started.

    Raises BadInputError.
    """
    document = read_document(path)
    spec = validate(LaunchFile, document)
    problems: list[Problem] = []
    check_hosts(spec.hosts, document, problems)
    if problems:
        raise BadInputError(problems)
    return {name: host.key for name, host in spec.hosts.items() if host.key is not None}


def launcher_on(host: str) -> str:
    """The launcher of a host, as a writer."""
    return LAUNCHER if host == MAIN else f"{LAUNCHER}_{host}"


def clock_node(host: str) -> str:
    """The node that measures the other hosts' clocks for a host."""
    return f"clock_{host}"


def is_loopback(address: str) -> bool:
    return ipaddress.ip_address(address).is_loopback
