"""Authenticate hosts by CURVE keys.

Every host has one CURVE key pair. The secret key is in a file that only its owner may read. The
launch file contains the public keys of all hosts. A bound socket accepts only connections from
hosts in the launch file. A handler in the event loop answers ZeroMQ's authentication requests
(protocol ZAP). A connecting socket requires the key of one host. Each end of a connection therefore
knows the host at the other end.

Keys are written as 40 characters in the encoding Z85.
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
from typing import ClassVar, Self

import zmq
from zmq.utils import z85

from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.files import make_write_error, write_file

KEY_LENGTH = 40
ZAP_ENDPOINT = "inproc://zeromq.zap.01"
ZAP_VERSION = b"1.0"
CURVE_KEY_BYTES = 32

RefusalHandler = Callable[[str], None]
"""A function that is called with a text for each refused connection."""


class SecurityError(FlexsheetError, RuntimeError):
    """Raised if a key is invalid or missing. The text names the file or host, and the remedy."""

    remedy = (
        "Run `flexsheet keys HOST` on that host, and enter its public key in the launch file "
        "on every host."
    )


def make_key_pair() -> tuple[str, str]:
    """Return a new pair of keys as (public, secret).

    The public key does not begin with a hyphen, so it can be an argument of a command.
    """
    while True:
        public, secret = zmq.curve_keypair()
        if not public.startswith(b"-"):
            return public.decode(), secret.decode()


def derive_public_key(secret: str) -> str:
    """Compute the public key that belongs to a secret key."""
    public: bytes = zmq.curve_public(secret.encode())
    return public.decode()


def is_key(text: str) -> bool:
    """Return whether a text is a valid Z85 key."""
    try:
        return len(text) == KEY_LENGTH and len(z85.decode(text.encode("ascii"))) == CURVE_KEY_BYTES
    except (ValueError, KeyError, struct.error):
        return False


def write_secret(path: Path, secret: str, *, replace: bool = False) -> None:
    """Write a secret key to a file that only its owner can read.

    replace: whether an existing file is replaced.

    Raises SecurityError if the file cannot be written, or if it exists and `replace` is false.
    """
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
            # Unlike a rename, a link does not replace an existing file.
            os.link(part, path)
    except FileExistsError as error:
        raise SecurityError(
            f"{path}: exists already; --replace creates a new key, which must be entered in the "
            "launch file on every host"
        ) from error
    except OSError as error:
        raise SecurityError(str(make_write_error(path, error))) from error
    finally:
        part.unlink(missing_ok=True)


def read_secret(path: Path) -> str:
    """Read a secret key.

    Raises SecurityError if the file is missing, invalid, or readable by other users.
    """
    try:
        with path.open() as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode) or status.st_uid != os.geteuid():
                raise SecurityError(
                    f"{path}: the file belongs to another user; create your own key: "
                    f"flexsheet keys {path.stem}"
                )
            if status.st_mode & 0o077:
                raise SecurityError(
                    f"{path}: other users may read it (mode {stat.S_IMODE(status.st_mode):04o}); "
                    f"create a new key, or, if nobody has read it: chmod 600 {path}"
                )
            text = file.read(KEY_LENGTH + 2).strip()
    except FileNotFoundError as error:
        raise SecurityError(
            f"{path}: does not exist; create a key: flexsheet keys {path.stem}"
        ) from error
    except (OSError, UnicodeDecodeError) as error:
        raise SecurityError(
            f"{path}: cannot be read: {error}; create a key: flexsheet keys {path.stem}"
        ) from error
    if not is_key(text):
        raise SecurityError(
            f"{path}: does not contain a key of {KEY_LENGTH} characters; create a key: "
            f"flexsheet keys {path.stem} --replace"
        )
    return text


@dataclass(frozen=True, slots=True)
class KeyRing:
    """The key pair of a host, and the public keys of all hosts by name."""

    public_key: str
    secret_key: str
    public: dict[str, str]

    @classmethod
    def load(cls, file: Path) -> Self:
        """Load a key ring from a JSON file that `write_ring` has written.

        Raises SecurityError if the JSON file or the file with the secret key is invalid.
        """
        try:
            ring = json.loads(file.read_text())
            host, secret_file, public = ring["host"], Path(ring["secret_file"]), ring["public"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise SecurityError(
                f"{file}: does not contain valid keys: {error}; start the graph again"
            ) from error
        secret = read_secret(secret_file)
        own = derive_public_key(secret)
        if public.get(host) != own:
            raise SecurityError(
                f'{secret_file}: does not match the key of host "{host}" in the launch file: '
                f"expected {public.get(host)}, found {own}; write the found key into the launch "
                "file with flexsheet keys HOST --install"
            )
        return cls(own, secret, public)

    def find_host(self, key: str) -> str | None:
        """Return the name of the host that has a public key, or None if no host has this key."""
        return next((name for name, one in self.public.items() if one == key), None)

    def set_server_keys(self, opened: zmq.Socket[bytes], domain: bytes) -> None:
        """Set the keys of a server socket, so that its peers must have a key of this ring.

        This applies to all endpoints that are bound after this call.

        domain: ZAP domain of the socket, which `ZapAuthenticator.register` returned.
        """
        opened.setsockopt(zmq.CURVE_SERVER, 1)
        opened.setsockopt(zmq.CURVE_SECRETKEY, self.secret_key.encode())
        opened.setsockopt(zmq.ZAP_DOMAIN, domain)
        # Without this option, every peer would be admitted if the authenticator were missing.
        opened.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)

    def set_client_keys(self, opened: zmq.Socket[bytes], host: str) -> None:
        """Set the keys of a client socket, so that the server must have the key of the given host.

        This applies to all endpoints that are connected after this call. Raises SecurityError if
        the host has no key.
        """
        if host not in self.public:
            raise SecurityError(
                f'host "{host}" has no key in the launch file; add its key to `hosts`'
            )
        opened.setsockopt(zmq.CURVE_SERVERKEY, self.public[host].encode())
        opened.setsockopt(zmq.CURVE_PUBLICKEY, self.public_key.encode())
        opened.setsockopt(zmq.CURVE_SECRETKEY, self.secret_key.encode())


def write_ring(file: Path, *, host: str, secret_file: Path, public: dict[str, str]) -> None:
    """Write the JSON file that `KeyRing.load` reads. The file is replaced atomically."""
    text = json.dumps({"host": host, "secret_file": str(secret_file), "public": public})
    write_file(file, text)


class ZapAuthenticator:
    """A handler of ZeroMQ's authentication requests (ZAP) for all sockets of a process.

    Each bound socket has its own ZAP domain, with a key ring and a function that reports refused
    connections.
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
        """Register a key ring for a socket, and return the new ZAP domain of the socket.

        on_refused: function that is called with a text for each refused connection.
        """
        if cls._present is None:
            cls._present = ZapAuthenticator()
        domain = f"flexsheet-{next(cls._numbers)}".encode()
        cls._present._domains[domain] = (keys, on_refused)
        return domain

    @classmethod
    def unregister(cls, domain: bytes) -> None:
        """Remove a ZAP domain. If no domain is left, close the authenticator."""
        if cls._present is None:
            return
        cls._present._domains.pop(domain, None)
        if not cls._present._domains:
            cls._present._close()
            cls._present = None

    def _close(self) -> None:
        if not self._loop.is_closed():
            self._loop.remove_reader(self._socket.fileno())
        # `close` alone would release the endpoint's name later, in ZeroMQ's thread.
        self._socket.unbind(ZAP_ENDPOINT)
        self._socket.close(linger=0)

    def _answer(self) -> None:
        while not self._socket.closed:
            try:
                request = self._socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            self._socket.send_multipart(self.reply(request))

    def reply(self, request: list[bytes]) -> list[bytes]:
        """Return the reply to an authentication request (ZAP).

        The status is 200, with the name of the host, if the key belongs to a host. Otherwise, the
        status is 400.
        """
        version, number, domain, address, _, mechanism, *credentials = request
        keys, on_refused = self._domains.get(domain, (None, lambda _: None))
        host, reason = None, "the peer uses no key"
        if keys is not None and version == ZAP_VERSION and mechanism == b"CURVE":
            key = z85.encode(credentials[0]).decode()
            host, reason = keys.find_host(key), f"no host of the plan has its key {key}"
        if host is None:
            on_refused(
                f"a connection from {address.decode(errors='replace')} was refused: {reason}"
            )
            return [ZAP_VERSION, number, b"400", b"not a host of the plan", b"", b""]
        return [ZAP_VERSION, number, b"200", b"OK", host.encode(), b""]
