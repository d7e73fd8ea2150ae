"""Keys between hosts: who may connect, whom one connects to, and files that hold secrets.

Every host has one CURVE key pair.  Its secret half stays in a file that only its owner may read;
the public halves of all hosts stand in the launch file.  Whoever binds lets in only the keys of
hosts of the plan (asked by ZeroMQ through ZAP, on the loop: no thread); whoever connects names the
key that must answer.  So each end of a connection knows which host the other one is.

Keys are written in Z85, 40 characters, as ZeroMQ does.
"""

from __future__ import annotations

import asyncio
import json
import os
import stat
import struct
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any, ClassVar

import zmq
from zmq.utils import z85

from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.files import write_error, write_file

KEY_LENGTH = 40
ZAP_ENDPOINT = "inproc://zeromq.zap.01"
ZAP_VERSION = b"1.0"
CURVE_KEY_BYTES = 32

RefusalHandler = Callable[[str], None]
"""Told in a sentence of a connection that was refused."""


class SecurityError(FlexsheetError, RuntimeError):
    """Keys that cannot be used; the sentence names file or host, and the remedy."""

    code = "keys"
    remedy = (
        "Run `flexsheet keys new HOST` on that host, and enter its public key in the launch file "
        "on every host."
    )


def new_key_pair() -> tuple[str, str]:
    """Make a (public, secret) key pair; no public key looks like an option of a command line."""
    while True:
        public, secret = zmq.curve_keypair()
        if not public.startswith(b"-"):
            return public.decode(), secret.decode()


def derive_public_key(secret: str) -> str:
    """The public key that belongs to a secret one."""
    public: bytes = zmq.curve_public(secret.encode())
    return public.decode()


def is_key(text: str) -> bool:
    """Return whether a text is a key in Z85."""
    try:
        return len(text) == KEY_LENGTH and len(z85.decode(text.encode("ascii"))) == CURVE_KEY_BYTES
    except (ValueError, KeyError, struct.error):
        return False


def write_secret(path: Path, secret: str, *, replace: bool = False) -> None:
    """Write a secret key so that only its owner can ever read it; SecurityError if it is there."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.unlink(missing_ok=True)
    try:
        fd = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(fd, "w") as file:
            file.write(secret + "\n")
        if replace:
            part.rename(path)
        else:
            # A link, unlike a rename, takes no other file's place.
            os.link(part, path)
    except FileExistsError as error:
        raise SecurityError(
            f"{path}: there is a key already; --replace makes a new one, which every host must be "
            "told of"
        ) from error
    except OSError as error:
        raise SecurityError(str(write_error(path, error))) from error
    finally:
        part.unlink(missing_ok=True)


def read_secret(path: Path) -> str:
    """The secret key in a file of our own that nobody else may read; SecurityError."""
    try:
        with path.open() as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode) or status.st_uid != os.geteuid():
                raise SecurityError(
                    f"{path}: belongs to somebody else; make one: flexsheet keys new"
                )
            if status.st_mode & 0o077:
                raise SecurityError(
                    f"{path}: others may read it (mode {stat.S_IMODE(status.st_mode):04o}); make a "
                    f"new key, or, if nobody has seen it: chmod 600 {path}"
                )
            text = file.read(KEY_LENGTH + 2).strip()
    except FileNotFoundError as error:
        raise SecurityError(
            f"{path}: there is no key; make one: flexsheet keys new {path.stem}"
        ) from error
    except (OSError, UnicodeDecodeError) as error:
        raise SecurityError(f"{path}: cannot be read: {error}") from error
    if not is_key(text):
        raise SecurityError(f"{path}: holds no key of {KEY_LENGTH} characters")
    return text


@dataclass(frozen=True, slots=True)
class KeyChange:
    """What a reload has changed: our own key, and the hosts whose keys are other ones or gone."""

    own: bool
    hosts: frozenset[str]


class KeyRing:
    """One host's key pair and the public keys of all hosts.

    file: JSON of {"host", "secret_file", "public": {host: key}}, written by `write_ring`.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        self._stamps: tuple[Any, ...] = ()
        self.host, self.public_key, self.secret_key = "", "", ""
        self.public: dict[str, str] = {}
        self._host_by_key: dict[str, str] = {}
        self.reload()

    def get_public_key(self, host: str) -> str:
        """The public key of a host; SecurityError for one that has none."""
        key = self.public.get(host)
        if key is None:
            raise SecurityError(f'host "{host}" has no key in the launch file')
        return key

    def find_host(self, key: str) -> str | None:
        """The host that has this public key; None for a stranger."""
        return self._host_by_key.get(key)

    def reload(self) -> KeyChange | None:
        """Read the files again if they have changed; what that changes, or None for nothing.

        Raises SecurityError for files that cannot be used; the keys then stay as they were.
        """
        try:
            ring = json.loads(self._file.read_text())
            host, secret_file, public = ring["host"], Path(ring["secret_file"]), ring["public"]
            stamps = (_stamp(self._file), _stamp(secret_file))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise SecurityError(f"{self._file}: holds no keys: {error}") from error
        if stamps == self._stamps:
            return None
        secret = read_secret(secret_file)
        own = derive_public_key(secret)
        if public.get(host) != own:
            raise SecurityError(
                f'{secret_file}: is not the key that the launch file has for host "{host}"; there: '
                f"{public.get(host)}, here: {own}; put it there: flexsheet keys install"
            )
        before = self.public
        change = KeyChange(
            own=bool(self.secret_key) and own != self.public_key,
            hosts=frozenset(name for name, key in before.items() if public.get(name) != key),
        )
        self.host, self.secret_key, self.public_key = host, secret, own
        self.public = dict(public)
        self._host_by_key = {key: name for name, key in self.public.items()}
        self._stamps = stamps
        return change

    def set_server_keys(self, opened: zmq.Socket[bytes], domain: bytes) -> None:
        """Let what is bound from now on take in only hosts of this ring."""
        opened.setsockopt(zmq.CURVE_SERVER, 1)
        opened.setsockopt(zmq.CURVE_SECRETKEY, self.secret_key.encode())
        opened.setsockopt(zmq.ZAP_DOMAIN, domain)
        # Without this, a gatekeeper that is not there would let everybody in.
        opened.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)

    def set_client_keys(self, opened: zmq.Socket[bytes], host: str) -> None:
        """Let what is connected from now on speak to that host alone."""
        opened.setsockopt(zmq.CURVE_SERVERKEY, self.get_public_key(host).encode())
        opened.setsockopt(zmq.CURVE_PUBLICKEY, self.public_key.encode())
        opened.setsockopt(zmq.CURVE_SECRETKEY, self.secret_key.encode())


def write_ring(file: Path, *, host: str, secret_file: Path, public: dict[str, str]) -> None:
    """Write what a `KeyRing` reads, at once."""
    text = json.dumps({"host": host, "secret_file": str(secret_file), "public": public})
    write_file(file, text)


class ZapAuthenticator:
    """Answers ZeroMQ's question whether a key may come in; one per process, while it is needed.

    Each bound socket has a domain of its own, and with it its ring and who is told of refusals.
    """

    _present: ClassVar[ZapAuthenticator | None] = None
    _numbers = count(1)

    def __init__(self) -> None:
        self._domains: dict[bytes, tuple[KeyRing, RefusalHandler]] = {}
        self._loop = asyncio.get_running_loop()
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.REP)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.bind(ZAP_ENDPOINT)
        self._loop.add_reader(self._socket.fileno(), self._answer)
        self._loop.call_soon(self._answer)

    @classmethod
    def register(cls, keys: KeyRing, on_refused: RefusalHandler) -> bytes:
        """Open a door; its domain, for `KeyRing.set_server_keys` and `unregister`."""
        if cls._present is None:
            cls._present = ZapAuthenticator()
        domain = f"flexsheet-{next(cls._numbers)}".encode()
        cls._present._domains[domain] = (keys, on_refused)
        return domain

    @classmethod
    def unregister(cls, domain: bytes) -> None:
        """Close a door; with the last one the gatekeeper goes."""
        if cls._present is None:
            return
        cls._present._domains.pop(domain, None)
        if not cls._present._domains:
            cls._present._close()
            cls._present = None

    def _close(self) -> None:
        if not self._loop.is_closed():
            self._loop.remove_reader(self._socket.fileno())
        # At once: a closed socket keeps its name until ZeroMQ's own thread has seen to it.
        self._socket.unbind(ZAP_ENDPOINT)
        self._socket.close(linger=0)

    def _answer(self) -> None:
        """The loop's callback: until nothing is left to be answered."""
        while not self._socket.closed:
            try:
                request = self._socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            self._socket.send_multipart(self.reply(request))

    def reply(self, request: list[bytes]) -> list[bytes]:
        """The frames of an answer: 200 and the host's name, or 400."""
        version, number, domain, address, _, mechanism, *credentials = request
        keys, on_refused = self._domains.get(domain, (None, lambda _: None))
        host, why = None, "a mechanism without keys"
        if keys is not None and version == ZAP_VERSION and mechanism == b"CURVE":
            key = z85.encode(credentials[0]).decode()
            host, why = keys.find_host(key), f"the key {key}, which no host of the plan has"
        if host is None:
            on_refused(f"a connection from {address.decode(errors='replace')} was refused: {why}")
            return [ZAP_VERSION, number, b"400", b"not a host of the plan", b"", b""]
        return [ZAP_VERSION, number, b"200", b"OK", host.encode(), b""]


def _stamp(path: Path) -> tuple[int, int, int] | None:
    """Another one for each state of a file; None where there is none."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return None
    return status.st_mtime_ns, status.st_ino, status.st_size
