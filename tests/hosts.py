"""Create hosts with secret files and key rings."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from flexsheet.messages.security import (
    KeyRing,
    derive_public_key,
    make_key_pair,
    read_secret,
    write_ring,
    write_secret,
)


class Hosts:
    """A set of hosts with key pairs. One further key pair, `stranger`, belongs to no host."""

    def __init__(self, folder: Path, *names: str) -> None:
        self.folder, self.names = folder, names
        for name in (*names, "stranger"):
            self.make_key(name)
        self.public = {name: self.derive_public_key(name) for name in names}

    def secret_file(self, name: str) -> Path:
        return self.folder / f"{name}.secret"

    def derive_public_key(self, name: str) -> str:
        return derive_public_key(read_secret(self.secret_file(name)))

    def make_key(self, name: str) -> str:
        public, secret = make_key_pair()
        write_secret(self.secret_file(name), secret, replace=True)
        return public

    def write_ring(self, name: str) -> Path:
        """Write the key ring of a host. The ring of a stranger also contains its own key."""
        file = self.folder / f"keys-{name}.json"
        public = (
            self.public
            if name in self.names
            else self.public | {name: self.derive_public_key(name)}
        )
        write_ring(file, host=name, secret_file=self.secret_file(name), public=public)
        return file

    def ring(self, name: str) -> KeyRing:
        return KeyRing.load(self.write_ring(name))


@contextmanager
def hosts(*names: str) -> Iterator[Hosts]:
    """Create hosts in a folder with a short path."""
    folder = Path(tempfile.mkdtemp(prefix="fs-", dir="/tmp"))
    try:
        yield Hosts(folder, *names)
    finally:
        shutil.rmtree(folder)
