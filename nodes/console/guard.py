"""Who may see the page: loopback by default, a token anywhere else, and no foreign web pages.

A page of another site that is open in somebody's browser can connect to sockets on that computer,
so a loopback address alone protects nothing: the Host and Origin of every request are looked at.
"""

from __future__ import annotations

import hmac
import http
import ipaddress
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import viser
import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from nodes.console.dress import dressed

LEAST_TOKEN = 16
COOKIE = "flexsheet-token"

PageRequest = Callable[[Any, Request], Response | None]


class ConsoleError(RuntimeError):
    """A page that cannot be served; the sentence says why and what to do."""


def read_token(path: Path) -> str:
    """The token in a file: one line that only its owner may read; ConsoleError otherwise."""
    try:
        mode, text = path.stat().st_mode, path.read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ConsoleError(f"token_file {path}: cannot be read: {error}") from error
    if mode & 0o077:
        raise ConsoleError(f"token_file {path}: others may read it; chmod 600 {path}")
    if len(text) < LEAST_TOKEN or not (text.isascii() and text.isalnum()):
        raise ConsoleError(
            f"token_file {path}: a token is {LEAST_TOKEN} or more letters and digits; make one with"
            f" python3 -c 'import secrets; print(secrets.token_hex(16))' > {path}"
        )
    return text


class Guard:
    """Judges each request for the page or its socket.

    address: that the page is served at.  token: None where everybody on this computer may look.
    """

    def __init__(self, address: str, token: str | None) -> None:
        if token is None and not ipaddress.ip_address(address).is_loopback:
            raise ConsoleError(
                f"address {address} is beyond loopback: name a token_file, or take 127.0.0.1 and "
                "come through ssh -L 8080:127.0.0.1:8080"
            )
        self._token = token

    def refusal(self, request: Request) -> Response | None:
        """What to answer instead of the page; None for a request that is welcome."""
        host = request.headers.get("Host", "")
        if not _names_an_address(host):
            return _page(
                http.HTTPStatus.FORBIDDEN, f"the console is not known as {host!r}; use its address"
            )
        origin = request.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return _page(http.HTTPStatus.FORBIDDEN, "another site's page may not use the console")
        if self._token is None:
            return None
        given = parse_qs(urlsplit(request.path).query).get("token", [""])[-1]
        if hmac.compare_digest(given.encode(), self._token.encode()):
            # Into a cookie, so that it does not stay in the address line and in bookmarks.
            to_page = {
                "Location": "/",
                "Set-Cookie": f"{COOKIE}={given}; HttpOnly; SameSite=Strict; Path=/",
            }
            return _page(http.HTTPStatus.SEE_OTHER, "welcome", to_page)
        if hmac.compare_digest(_cookie(request).encode(), self._token.encode()):
            return None
        return _page(
            http.HTTPStatus.UNAUTHORIZED,
            "this console needs its token: open http://ADDRESS:PORT/?token=... with what is in the "
            "console's token_file",
        )


def _names_an_address(host: str) -> bool:
    """Whether a Host header is an IP address or localhost: a name could be anybody's."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
        return name == "localhost" or bool(ipaddress.ip_address(name))
    except ValueError:
        return False


def _cookie(request: Request) -> str:
    try:
        held = SimpleCookie(request.headers.get("Cookie", "")).get(COOKIE)
    except CookieError:
        return ""
    return "" if held is None else held.value


def _page(status: http.HTTPStatus, text: str, more: dict[str, str] | None = None) -> Response:
    escaped = text.replace("&", "&amp;").replace("<", "&lt;")
    body = (
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>flexsheet</title>'
        f'<body style="font: 1.2rem sans-serif; margin: 3rem"><h1>{status.phrase}</h1>'
        f"<p>{escaped}</p></body></html>"
    ).encode()
    headers = Headers(
        {
            "Content-Type": "text/html; charset=utf-8",
            "Content-Length": str(len(body)),
            "Connection": "close",
            **(more or {}),
        }
    )
    return Response(status, status.phrase, headers, body)


def start_server(address: str, port: int, guard: Guard, label: str) -> viser.ViserServer:
    """A viser server at exactly that address, every request judged by the guard; ConsoleError.

    viser offers neither: it takes the next free port where one is in use, and asks nobody who he
    is.  So the port is tried first, and the guard is put before viser's own answers at the one
    place where it starts to listen; a viser that starts to listen elsewhere is not served at all.
    """
    _refuse_taken(address, port)
    with _guarding(guard) as guarded:
        server = viser.ViserServer(host=address, port=port, label=label, verbose=False)
    if not guarded:
        server.stop()
        raise ConsoleError(
            f"viser {viser.__version__} cannot be guarded by this console: install 1.1"
        )
    if port not in (0, server.get_port()):
        server.stop()
        raise ConsoleError(_taken(address, port))
    return server


@contextmanager
def _guarding(guard: Guard) -> Iterator[list[PageRequest]]:
    """While this holds, servers of websockets ask the guard first; gives those that were made."""
    serve = websockets.asyncio.server.serve
    guarded: list[PageRequest] = []

    def answer(ask_viser: PageRequest, connection: Any, request: Request) -> Response | None:
        refused = guard.refusal(request)
        if refused is not None:
            return refused
        answered = ask_viser(connection, request)
        return None if answered is None else dressed(answered)

    def serve_guarded(*arguments: Any, process_request: PageRequest, **rest: Any) -> Any:
        guarded.append(process_request)
        return serve(*arguments, process_request=partial(answer, process_request), **rest)

    websockets.asyncio.server.serve = serve_guarded  # type: ignore[assignment,misc]  # see start_server
    try:
        yield guarded
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]  # as it was


def _refuse_taken(address: str, port: int) -> None:
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address, port))
        except OSError as error:
            raise ConsoleError(_taken(address, port)) from error


def _taken(address: str, port: int) -> str:
    return (
        f"page_port {port} of {address} cannot be had; another console? "
        "take another with --set console.page_port=PORT"
    )
