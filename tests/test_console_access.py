"""Test the access control of the page."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Iterator

import pytest
import viser
import websockets
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from flexsheet.nodes.console.access_control import (
    ConsoleError,
    inject_assets,
    is_allowed,
    start_server,
)
from tests.waiting import DEADLINE_S


def asked(*hosts: str, origins: tuple[str, ...] = ()) -> Request:
    headers = Headers()
    for name, values in (("Host", hosts), ("Origin", origins)):
        for value in values:
            headers[name] = value
    return Request("/", headers)


@pytest.mark.parametrize(
    ("request_", "allowed"),
    [
        (asked("127.0.0.1:8080"), True),
        (asked("localhost:8080"), True),
        (asked("[::1]:8080"), True),
        (asked("127.0.0.1:8080", origins=("http://127.0.0.1:8080",)), True),
        (asked("127.0.0.1:8080", origins=("http://evil.example",)), False),
        (asked("127.0.0.1:8080", origins=("http://127.0.0.1:9",)), False),
        (asked("127.0.0.1:8080", origins=("null",)), False),
        (asked("127.0.0.1:8080", origins=("http://[",)), False),
        (asked("127.0.0.1", origins=("http://127.0.0.1", "http://evil.example")), False),
        (asked("evil.example:8080", origins=("http://evil.example:8080",)), False),
        (asked("192.0.2.1:8080"), False),
        (asked("127.0.0.1", "127.0.0.1"), False),
        (asked("[::1"), False),
        (asked(""), False),
        (asked(), False),
    ],
)
def test_only_pages_of_the_console_itself_may_ask(request_: Request, allowed: bool) -> None:
    assert is_allowed(request_) == allowed


def test_the_page_is_served_with_our_style_and_script() -> None:
    def answer(page: bytes, kind: str = "text/html; charset=utf-8") -> Response:
        headers = Headers({"Content-Type": kind, "Content-Length": str(len(page))})
        return Response(200, "OK", headers, page)

    served = inject_assets(answer(b"<html><head><title>x</title></head><body></body></html>"))
    assert served.headers.get_all("Content-Length") == [str(len(served.body))]
    head, _, rest = bytes(served.body).partition(b"</head>")
    assert b"--fs-text" in head
    assert b"E-STOP" in head
    assert rest == b"<body></body></html>"
    for other in (
        answer(b"no page"),
        answer(b"</head>", "image/png"),
        Response(401, "", Headers()),
    ):
        assert bytes(inject_assets(other).body) == bytes(other.body)


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    """Start a page, and yield its port."""
    server = start_server(0, "test")
    yield server.get_port()
    server.stop()


async def answer_to(port: int, sent: bytes) -> tuple[int, dict[str, str]]:
    """Send bytes, and return the status and the headers (in lower case) of the response."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(sent)
    async with asyncio.timeout(DEADLINE_S):
        head = await reader.readuntil(b"\r\n\r\n")
    writer.close()
    first, *rest = head.decode().split("\r\n")
    pairs = (line.partition(": ") for line in rest if line)
    return int(first.split()[1]), {name.lower(): value for name, _, value in pairs}


HOST = b"Host: 127.0.0.1\r\n"


async def test_foreign_requests_are_answered_with_403(port: int) -> None:
    for headers, expected in (
        (HOST, 200),
        (HOST + b"Accept-Encoding: gzip\r\n", 200),
        (HOST + b"Origin: http://evil.example\r\n", 403),
        (HOST + b"Origin: http://127.0.0.1\r\n" + b"Origin: http://evil.example\r\n", 403),
        (b"Host: evil.example\r\n", 403),
        (2 * HOST, 403),
        (b"", 403),
    ):
        status, answered = await answer_to(port, b"GET / HTTP/1.1\r\n" + headers + b"\r\n")
        assert status == expected
        assert (answered.get("x-frame-options") == "DENY") == (status == 200)
        assert answered.get("content-encoding") in (None, "identity")


async def test_a_foreign_page_cannot_open_a_websocket(port: int) -> None:
    protocol = websockets.Subprotocol(f"viser-v{viser.__version__}")
    address = f"ws://127.0.0.1:{port}"
    own = websockets.Origin(f"http://127.0.0.1:{port}")
    async with websockets.connect(address, origin=own, subprotocols=[protocol]) as opened:
        async with asyncio.timeout(DEADLINE_S):
            assert await opened.recv()
    with pytest.raises(websockets.InvalidStatus, match="403"):
        await websockets.connect(
            address, origin=websockets.Origin("http://evil.example"), subprotocols=[protocol]
        )


def test_a_used_port_is_reported() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        number = taken.getsockname()[1]
        with pytest.raises(ConsoleError, match=f"port {number} is in use"):
            start_server(number, "test")
