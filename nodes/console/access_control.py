"""Start the console's web server, which listens on loopback and serves only its own page.

A web page of another site that is open in a browser on this computer could connect to the console
and move the arms. The headers Host and Origin of every request are therefore checked.
"""

from __future__ import annotations

import io
import socket
from contextlib import redirect_stdout
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server
from websockets.http11 import Request, Response

from flexsheet.messages.errors import FlexsheetError

ADDRESS = "127.0.0.1"
OWN_NAMES = (ADDRESS, "::1", "localhost")
"""The host names under which a browser may open the page.

The web site of an attacker could make its own name resolve to this computer (DNS rebinding).
"""


HERE = Path(__file__).resolve().parent


class ConsoleError(FlexsheetError, RuntimeError):
    """The error raised if the console cannot serve the page."""


def is_allowed(request: Request) -> bool:
    """Return whether a request names this computer, and does not come from a page of another site.

    A request without the header Origin does not come from a page, or opens the page itself.
    """
    try:
        host = request.headers["Host"]
        origins = request.headers.get_all("Origin")
        return urlsplit(f"//{host}").hostname in OWN_NAMES and all(
            urlsplit(origin).netloc == host for origin in origins
        )
    except (LookupError, ValueError):
        # A header is missing, repeated or invalid.
        return False


def inject_assets(response: Response) -> Response:
    """Add page.css and page.js to the head of an HTML page; return other responses unchanged.

    viser's page has sliders without names, folders that cannot be opened by keyboard, and labels
    with too little contrast. If the connection is lost, it shows only a red dot.
    """
    if not response.headers.get("Content-Type", "").startswith("text/html"):
        return response
    style, script = ((HERE / name).read_bytes() for name in ("page.css", "page.js"))
    ours = b"<style>" + style + b"</style><script>" + script + b"</script></head>"
    response.body = bytes(response.body).replace(b"</head>", ours)
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))
    # In a frame, another page could hide the element that the user clicks.
    response.headers["X-Frame-Options"] = "DENY"
    return response


def start_server(port: int, label: str) -> viser.ViserServer:
    """Start a viser server that checks each request.

    port: TCP port; 0 means any free port.
    label: heading of the control panel.

    Raises ConsoleError if the port is in use, or if this version of viser cannot be checked.
    """
    serve = websockets.asyncio.server.serve
    checked: list[bool] = []

    def serve_checked(*arguments: Any, process_request: Any, **options: Any) -> Any:
        def respond(connection: Any, request: Request) -> Response | None:
            if not is_allowed(request):
                text = f"open the console at http://{ADDRESS}:{server.get_port()}/\n"
                refusal: Response = connection.respond(HTTPStatus.FORBIDDEN, text)
                return refusal
            # The page is not compressed, so that it can be completed.
            if "Accept-Encoding" in request.headers:
                del request.headers["Accept-Encoding"]
            response = process_request(connection, request)
            return None if response is None else inject_assets(response)

        checked.append(True)
        return serve(*arguments, process_request=respond, **options)

    # viser uses the next free port if the requested port is in use, so test the port first.
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((ADDRESS, port))
        except OSError as error:
            raise ConsoleError(
                f"page_port: port {port} is in use; choose another: --set console.page_port=PORT"
            ) from error
    # viser has no option for `process_request`, so it starts with another `serve`, which the types
    # of websockets do not allow. It prints its address before the graph is ready.
    websockets.asyncio.server.serve = serve_checked  # type: ignore[assignment,misc]
    try:
        with redirect_stdout(io.StringIO()):
            server = viser.ViserServer(host=ADDRESS, port=port, label=label, verbose=False)
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]
    if not checked or port not in (0, server.get_port()):
        server.stop()
        raise ConsoleError(
            f"page_port: viser {viser.__version__} does not serve a checked page at port {port}; "
            "install viser 1.1, or choose another port"
        )
    return server
