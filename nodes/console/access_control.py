"""Control access to the console page.

By default, only users of this computer have access, and users of other computers need a token. A
web page of another site that is open in a browser on this computer could connect to the console.
Listening on the loopback address is therefore insufficient, and the Host and Origin headers of
every request are checked. Other pages must not show the console in a frame. Such a page could hide
the element that the user clicks.
"""

from __future__ import annotations

import asyncio
import hmac
import http
import io
import ipaddress
import logging
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
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

FRAMING_HEADERS = {"X-Frame-Options": "DENY", "Content-Security-Policy": "frame-ancestors 'none'"}
"""The response headers that prevent other pages from showing the console in a frame."""

FRAME_DESTINATIONS = ("iframe", "frame", "fencedframe", "embed", "object")
"""The values of the header Sec-Fetch-Dest that indicate a page embedded in another page."""

SINGLE_HEADERS = ("Host", "Origin", "Upgrade", "Accept-Encoding", "Cookie", "Sec-Fetch-Dest")
"""The request headers that the access control reads. A request that repeats one of these headers is
malformed."""

MALFORMED = (
    "the console cannot read this HTTP request; open the address of the console in a browser"
)
CLOSE_TIMEOUT_S = 1.0
"""The time (s) for which a refused connection stays open, so that the client can read the reason
for the refusal."""

PageRequest = Callable[[Any, Request], Response | None]


class ConsoleError(FlexsheetError, RuntimeError):
    """The error raised if the console cannot serve the page."""

    code = "console"
    remedy = "Choose another port, or set a token if the page is open to the network."


def read_token(path: Path) -> str:
    """Read the access token from a file.

    Raises ConsoleError if the file cannot be read, or if other users can read the file. The error
    is also raised if the token is too short, or contains characters other than letters and digits.
    """
    try:
        mode, text = path.stat().st_mode, path.read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ConsoleError(
            f"token_file {path}: the file cannot be read: {error}; check the path and permissions"
        ) from error
    if mode & 0o077:
        raise ConsoleError(
            f"token_file {path}: other users can read the file; run chmod 600 {path}"
        )
    if len(text) < MIN_TOKEN_LENGTH or not (text.isascii() and text.isalnum()):
        raise ConsoleError(
            f"token_file {path}: the token must have at least {MIN_TOKEN_LENGTH} letters and "
            "digits and no other characters; create the file with "
            f"python3 -c 'import secrets; print(secrets.token_hex(16))' > {path}"
        )
    return text


class AccessControl:
    """The access control for HTTP and WebSocket requests to the console page.

    address: IP address at which the page is served.
    token: required token; None permits every user of this computer.

    Raises ConsoleError if the address is not a loopback address and there is no token.
    """

    def __init__(self, address: str, token: str | None) -> None:
        if token is None and not ipaddress.ip_address(address).is_loopback:
            raise ConsoleError(
                f"address {address} is not loopback and requires a token; set token_file, or use "
                "127.0.0.1 with ssh -L 8080:127.0.0.1:8080"
            )
        self._token = token

    def refusal(self, request: Request) -> Response | None:
        """Return the response that refuses a request, or None if the request is allowed."""
        try:
            return self._refusal(request)
        except (ValueError, MultipleValuesError):
            return make_bad_request()

    def _refusal(self, request: Request) -> Response | None:
        repeated = [name for name in SINGLE_HEADERS if len(request.headers.get_all(name)) > 1]
        if repeated or "Host" not in request.headers:
            return make_bad_request()
        host = request.headers["Host"]
        if request.headers.get("Sec-Fetch-Dest") in FRAME_DESTINATIONS:
            return _page(
                http.HTTPStatus.FORBIDDEN,
                "no page may show the console in a frame; open the console in its own tab",
            )
        if not _names_an_address(host):
            return _page(
                http.HTTPStatus.FORBIDDEN,
                f"the console cannot be opened under the name {host!r}; use its IP address",
            )
        origin = request.headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return _page(
                http.HTTPStatus.FORBIDDEN,
                "pages of other sites may not use the console; open its address directly",
            )
        if self._token is None:
            return None
        token = parse_qs(urlsplit(request.path).query).get("token", [""])[-1]
        if hmac.compare_digest(token.encode(), self._token.encode()):
            # A cookie keeps the token out of the address bar and of bookmarks.
            to_page = {
                "Location": "/",
                "Set-Cookie": f"{COOKIE}={token}; HttpOnly; SameSite=Strict; Path=/",
            }
            return _page(http.HTTPStatus.SEE_OTHER, "welcome", to_page)
        if hmac.compare_digest(_cookie(request).encode(), self._token.encode()):
            return None
        return _page(
            http.HTTPStatus.UNAUTHORIZED,
            "this console requires a token; open http://ADDRESS:PORT/?token=TOKEN, where TOKEN "
            "is the content of the console's token_file",
        )


def _names_an_address(host: str) -> bool:
    """Return whether a Host header contains an IP address or localhost.

    The console rejects all other names. An attacker's web site could make its own host name resolve
    to this computer (DNS rebinding).
    """
    try:
        name = urlsplit(f"//{host}").hostname or ""
        return name == "localhost" or bool(ipaddress.ip_address(name))
    except ValueError:
        return False


def _cookie(request: Request) -> str:
    try:
        cookie = SimpleCookie(request.headers.get("Cookie", "")).get(COOKIE)
    except CookieError:
        return ""
    return "" if cookie is None else cookie.value


def make_bad_request() -> Response:
    """Return the response to a malformed request."""
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
    """Add the headers that prevent a browser from showing the response in a frame."""
    response.headers.update(FRAMING_HEADERS)
    return response


def make_page_logger() -> logging.Logger:
    """Return the logger of the page's server. The logger writes each error as one line of text."""
    logger = logging.getLogger("flexsheet.console")
    if not logger.filters:
        logger.addFilter(shorten_traceback)
    return logger


def shorten_traceback(record: logging.LogRecord) -> bool:
    """Replace the traceback of a log record by its last line.

    Returns True, so the logger outputs the record.
    """
    if record.exc_info and record.exc_info[1] is not None:
        error = record.exc_info[1]
        record.msg = f"{record.getMessage()}: {type(error).__name__}: {error}".replace("\n", " ")
        record.args, record.exc_info, record.exc_text = (), None, None
    return True


class PageConnection(ServerConnection):
    """A connection that answers malformed HTTP requests with the status 400."""

    refused = False

    def send_data(self) -> None:
        """Send the buffered data. If a request was malformed, send a refusal first."""
        malformed = isinstance(self.protocol.handshake_exc, InvalidMessage)
        if malformed and not self.refused and not self.transport.is_closing():
            self.refused = True
            self.transport.write(forbid_framing(make_bad_request()).serialize())
        super().send_data()

    async def handshake(self, *arguments: Any, **rest: Any) -> None:
        """Perform the opening handshake. If it is invalid, wait until the client disconnects."""
        try:
            await super().handshake(*arguments, **rest)
        except InvalidHandshake:
            # If the connection were closed at once, the client might not read the refusal.
            await asyncio.wait([self.connection_lost_waiter], timeout=CLOSE_TIMEOUT_S)


def start_server(address: str, port: int, access: AccessControl, label: str) -> viser.ViserServer:
    """Start a viser server with access control at the requested address and port.

    label: heading of the control panel.

    Raises ConsoleError if the port is in use, or if the installed version of viser does not support
    the access control.
    """
    # viser uses the next free port if the requested port is in use, so test the port first.
    _check_port_is_free(address, port)
    # viser prints its address before the graph is ready; the launcher prints it afterwards.
    with _checking(access) as checked_servers, redirect_stdout(io.StringIO()):
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
    """Add access control to every websockets server that starts while the context is active.

    Yields a list to which the original request handler of each server is added.
    """
    serve = websockets.asyncio.server.serve
    checked_servers: list[PageRequest] = []

    def respond(viser_handler: PageRequest, connection: Any, request: Request) -> Response | None:
        response = access.refusal(request)
        if response is None:
            try:
                response = viser_handler(connection, request)
            except (OSError, ValueError):  # a path that is invalid in the file system
                response = make_bad_request()
        return None if response is None else forbid_framing(inject_assets(response))

    def serve_checked(*arguments: Any, process_request: PageRequest, **rest: Any) -> Any:
        checked_servers.append(process_request)
        return serve(
            *arguments,
            process_request=partial(respond, process_request),
            create_connection=PageConnection,
            logger=make_page_logger(),
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
        f"page_port: port {port} of {address} is in use; "
        "choose another port with --set console.page_port=PORT"
    )
