"""Check that the addresses and keys of hosts are valid and unique.

The module also defines the names of nodes and topic writers that exist once per host.
"""

from __future__ import annotations

import ipaddress

from flexsheet.launch.plans.documents import Document, Key
from flexsheet.launch.plans.launch_file import HostSpec
from flexsheet.launch.plans.plan_model import LAUNCHER, MAIN
from flexsheet.messages.security import is_key


def check_hosts(hosts: dict[str, HostSpec], document: Document) -> None:
    """Report a problem if the address or the key of a host is invalid or not unique."""
    if MAIN not in hosts:
        document.report(
            ("hosts",), f'no host is named "{MAIN}"', "rename the host that runs the tools"
        )
    _check_keys(hosts, document)
    host_by_address: dict[str, str] = {}
    for name, host in hosts.items():
        key: Key = ("hosts", name, "address")
        try:
            address = ipaddress.ip_address(host.address)
        except ValueError:
            document.report(
                key, f'"{host.address}" is not an IP address', 'write it as "192.0.2.10"'
            )
            continue
        if address.is_unspecified or address.is_multicast:
            document.report(
                key,
                f'"{host.address}" is not the address of a single host',
                "write the IP address of this host",
            )
        other = host_by_address.setdefault(host.address, name)
        if other != name:
            document.report(
                key,
                f'"{host.address}" is also the address of host "{other}"',
                "correct one of the two addresses, or merge the two hosts",
            )


def _check_keys(hosts: dict[str, HostSpec], document: Document) -> None:
    host_by_key: dict[str, str] = {}
    for name, host in hosts.items():
        where: Key = ("hosts", name, "key")
        if host.key is None:
            if any(other.key is not None for other in hosts.values()):
                document.report(
                    ("hosts", name),
                    "the host has no key, but other hosts have one",
                    f"create one on that host (flexsheet keys {name}), then: "
                    f"flexsheet keys {name} --install FILE --key KEY",
                )
        elif not is_key(host.key):
            document.report(
                where,
                f'"{host.key}" is not a public key',
                f"give the 40 characters that `flexsheet keys {name}` prints",
            )
        elif host_by_key.setdefault(host.key, name) != name:
            document.report(
                where,
                f'the same key belongs to host "{host_by_key[host.key]}"',
                "create a separate key for each host",
            )


def launcher_on(host: str) -> str:
    """Return the name under which the launcher on a host publishes messages."""
    return LAUNCHER if host == MAIN else f"{LAUNCHER}_{host}"


def clock_node(host: str) -> str:
    """Return the name of the node on a host that measures the clocks of the other hosts."""
    return f"clock_{host}"


def is_loopback(address: str) -> bool:
    return ipaddress.ip_address(address).is_loopback
