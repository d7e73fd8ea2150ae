"""Control access to the page: loopback by default, a token elsewhere, and no foreign web pages.

A page of another site, open in somebody's browser, can connect to sockets on that computer. A
loopback address alone therefore protects nothing: the Host and Origin of every request are checked.
No page may show the console in a frame, where a click could be led to an unseen button.
"""

from __future__ import annotations

import asyncio
import hmac
import http
import ipaddress
import logging
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
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers, MultipleValuesError
from websockets.exceptions import InvalidHandshake, InvalidMessage
from websockets.http11 import Request, Response

from flexsheet.messages.errors import FlexsheetError
from flexsheet.nodes.console.html_head import inject_assets

MIN_TOKEN_LENGTH = 16
COOKIE = "flexsheet-token"

FRAMING_HEADERS = {
    "X-Frame-Options": "DENY",
    "Content-Security-Policy": "frame-ancestors 'none'",
}
"""Headers of every answer."""

FRAME_DESTINATIONS = ("iframe", "frame", "fencedframe", "embed", "object")
"""Values of Sec-Fetch-Dest with which a browser requests a page to show it inside another one."""

SINGLE_HEADERS = ("Host", "Origin", "Upgrade", "Accept-Encoding", "Cookie", "Sec-Fetch-Dest")
"""Headers that are read; a request that repeats one of them is malformed."""

MALFORMED = "the console cannot read this HTTP request; open its address in a browser"
CLOSE_TIMEOUT_S = 1.0
"""Time that a client has to read why its request was refused."""

PageRequest = Callable[[Any, Request], Response | None]


class ConsoleError(FlexsheetError, RuntimeError):
    """Report that the page cannot be served, why, and what to do."""

    code = "console"
    remedy = "Choose another port, or set a token if the page is open to the network."


def read_token(path: Path) -> str:
    """Read a token file: one line, readable by its owner alone; ConsoleError otherwise."""
    try:
        mode, text = path.stat().st_mode, path.read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ConsoleError(f"token_file {path}: cannot be read: {error}") from error
    if mode & 0o077:
        raise ConsoleError(f"token_file {path}: other users can read it; run chmod 600 {path}")
    if len(text) < MIN_TOKEN_LENGTH or not (text.isascii() and text.isalnum()):
        raise ConsoleError(
            f"token_file {path}: needs {MIN_TOKEN_LENGTH} or more letters and digits; make one with"
            f" python3 -c 'import secrets; print(secrets.token_hex(16))' > {path}"
        )
    return text


class AccessControl:
    """Check each request for the page or its socket.

    address: IP address at which the page is served. token: None lets everybody on this computer in.
    """

    def __init__(self, address: str, token: str | None) -> None:
        if token is None and not ipaddress.ip_address(address).is_loopback:
            raise ConsoleError(
                f"address {address} is not loopback: set token_file, or use 127.0.0.1 with "
                "ssh -L 8080:127.0.0.1:8080"
            )
        self._token = token

    def refusal(self, request: Request) -> Response | None:
        """Return the answer to send instead of the page; None for a permitted request."""
        try:
            return self._refusal(request)
        except (ValueError, MultipleValuesError):
            return bad_request()

    def _refusal(self, request: Request) -> Response | None:
        """Return as `refusal`; ValueError or MultipleValuesError for a malformed request."""
        repeated = [name for name in SINGLE_HEADERS if len(request.headers.get_all(name)) > 1]
        if repeated or "Host" not in request.headers:
            return bad_request()
        host = request.headers["Host"]
        if request.headers.get("Sec-Fetch-Dest") in FRAME_DESTINATIONS:
            return _page(http.HTTPStatus.FORBIDDEN, "no page may show the console in a frame")
        if not _names_an_address(host):
            return _page(
                http.HTTPStatus.FORBIDDEN,
                f"the console does not answer to the name {host!r}; use its IP address",
            )
        origin = request.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return _page(http.HTTPStatus.FORBIDDEN, "another site's page may not use the console")
        if self._token is None:
            return None
        given = parse_qs(urlsplit(request.path).query).get("token", [""])[-1]
        if hmac.compare_digest(given.encode(), self._token.encode()):
            # A cookie, so that the token does not stay in the address line and in bookmarks.
            to_page = {
                "Location": "/",
                "Set-Cookie": f"{COOKIE}={given}; HttpOnly; SameSite=Strict; Path=/",
            }
            return _page(http.HTTPStatus.SEE_OTHER, "welcome", to_page)
        if hmac.compare_digest(_cookie(request).encode(), self._token.encode()):
            return None
        return _page(
            http.HTTPStatus.UNAUTHORIZED,
            "this console needs its token: open http://ADDRESS:PORT/?token=TOKEN with the "
            "content of the console's token_file",
        )


def _names_an_address(host: str) -> bool:
    """Return whether a Host header is an IP address or localhost: any site can own a name."""
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


def bad_request() -> Response:
    return _page(http.HTTPStatus.BAD_REQUEST, MALFORMED)


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


def forbid_framing(response: Response) -> Response:
    """Add the headers that keep a browser from showing the answer in a frame."""
    response.headers.update(FRAMING_HEADERS)
    return response


def page_logger() -> logging.Logger:
    """Return the logger of the page server.

    It logs one line, not a traceback, for bytes that a client sent.
    """
    logger = logging.getLogger("flexsheet.console")
    if not logger.filters:
        logger.addFilter(shorten_traceback)
    return logger


def shorten_traceback(record: logging.LogRecord) -> bool:
    """Replace a record's traceback by its last line."""
    if record.exc_info and record.exc_info[1] is not None:
        error = record.exc_info[1]
        record.msg = f"{record.getMessage()}: {type(error).__name__}: {error}".replace("\n", " ")
        record.args, record.exc_info, record.exc_text = (), None, None
    return True


class PageConnection(ServerConnection):
    """Answer malformed HTTP with status 400, where websockets logs a traceback."""

    refused = False

    def send_data(self) -> None:
        """Send the data of the protocol; to a malformed request first the refusal."""
        malformed = isinstance(self.protocol.handshake_exc, InvalidMessage)
        if malformed and not self.refused and not self.transport.is_closing():
            self.refused = True
            self.transport.write(forbid_framing(bad_request()).serialize())
        super().send_data()

    async def handshake(self, *arguments: Any, **rest: Any) -> None:
        """Perform the opening handshake; a malformed one ends the connection."""
        try:
            await super().handshake(*arguments, **rest)
        except InvalidHandshake:
            # A client whose connection is closed at once might not read the answer.
            await asyncio.wait([self.connection_lost_waiter], timeout=CLOSE_TIMEOUT_S)


def start_server(address: str, port: int, access: AccessControl, label: str) -> viser.ViserServer:
    """Start a viser server at exactly this address, with access control; ConsoleError.

    viser takes the next free port if the given one is in use, and accepts every client. The port is
    therefore tried first, and the access control runs before viser's own request handler. It is
    installed where viser starts to listen. A viser that starts to listen elsewhere is not served.
    """
    _check_port_is_free(address, port)
    with _checking(access) as checked_servers:
        server = viser.ViserServer(host=address, port=port, label=label, verbose=False)
    if not checked_servers:
        server.stop()
        raise ConsoleError(
            f"viser {viser.__version__} does not support the console's access control; "
            "install viser 1.1"
        )
    if port not in (0, server.get_port()):
        server.stop()
        raise ConsoleError(_port_in_use_text(address, port))
    return server


@contextmanager
def _checking(access: AccessControl) -> Iterator[list[PageRequest]]:
    """Let new servers of websockets check each request with `access` first.

    Yields the list of the request handlers that were replaced.
    """
    serve = websockets.asyncio.server.serve
    checked_servers: list[PageRequest] = []

    def answer(ask_viser: PageRequest, connection: Any, request: Request) -> Response | None:
        answered = access.refusal(request)
        if answered is None:
            try:
                answered = ask_viser(connection, request)
            except (OSError, ValueError):  # a path that no file system takes
                answered = bad_request()
        return None if answered is None else forbid_framing(inject_assets(answered))

    def serve_checked(*arguments: Any, process_request: PageRequest, **rest: Any) -> Any:
        checked_servers.append(process_request)
        return serve(
            *arguments,
            process_request=partial(answer, process_request),
            create_connection=PageConnection,
            logger=page_logger(),
            **rest,
        )

    websockets.asyncio.server.serve = serve_checked  # type: ignore[assignment,misc]  # see start_server
    try:
        yield checked_servers
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]  # as it was


def _check_port_is_free(address: str, port: int) -> None:
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address, port))
        except OSError as error:
            raise ConsoleError(_port_in_use_text(address, port)) from error


def _port_in_use_text(address: str, port: int) -> str:
    return (
        f"page_port {port} of {address} is in use, perhaps by another console; "
        "choose another port with --set console.page_port=PORT"
    )
