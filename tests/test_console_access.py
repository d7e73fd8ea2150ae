"""Test the access control of the page."""

from __future__ import annotations

import asyncio
import gzip
import logging
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import viser
import websockets
from numpy.typing import NDArray
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from flexsheet.nodes.console.access_control import (
    COOKIE,
    AccessControl,
    ConsoleError,
    make_page_logger,
    read_token,
    start_server,
)
from flexsheet.nodes.console.html_head import inject_assets
from flexsheet.nodes.console.node import ConsoleParameters
from tests.waiting import DEADLINE_S

Floats = NDArray[np.float64]
TOKEN = "0123456789abcdef0123"


def asked(path: str = "/", host: str = "127.0.0.1:8080", **headers: str) -> Request:
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    return Request(path, Headers({"Host": host, **named}))


def status_of(access: AccessControl, request: Request) -> int:
    refused = access.refusal(request)
    return 200 if refused is None else refused.status_code


def test_on_loopback_only_the_computers_own_pages_may_ask() -> None:
    access = AccessControl("127.0.0.1", None)
    assert status_of(access, asked()) == 200
    assert status_of(access, asked(host="localhost:8080")) == 200
    assert status_of(access, asked(host="[::1]:8080")) == 200
    assert status_of(access, asked(Origin="http://127.0.0.1:8080", Upgrade="websocket")) == 200
    assert status_of(access, asked(Origin="http://evil.example", Upgrade="websocket")) == 403
    assert status_of(access, asked(Origin="null")) == 403
    assert status_of(access, asked(host="evil.example:8080")) == 403, "a name bound to loopback"
    assert status_of(access, asked(host="")) == 403
    for destination in ("iframe", "frame", "embed", "object"):
        assert status_of(access, asked(Sec_Fetch_Dest=destination)) == 403
    assert status_of(access, asked(Sec_Fetch_Dest="document")) == 200
    assert status_of(access, asked(host="[::1")) == 403


def test_with_a_token_who_does_not_know_it_is_sent_away() -> None:
    access = AccessControl("192.0.2.1", TOKEN)
    host = "192.0.2.1:8080"
    assert status_of(access, asked(host=host)) == 401
    assert status_of(access, asked(f"/?token={TOKEN}x", host)) == 401
    assert status_of(access, asked("/?token=", host)) == 401
    assert status_of(access, asked("/?token=ü", host)) == 401
    welcome = access.refusal(asked(f"/?token={TOKEN}", host))
    assert welcome is not None
    assert (welcome.status_code, welcome.headers["Location"]) == (303, "/")
    cookie = welcome.headers["Set-Cookie"].partition(";")[0]
    assert cookie == f"{COOKIE}={TOKEN}"
    assert status_of(access, asked(host=host, Cookie=cookie)) == 200
    assert status_of(access, asked(host=host, Cookie=f"{COOKIE}=guess")) == 401
    assert status_of(access, asked(host=host, Cookie='a=b=;;"==')) == 401
    wrong = asked(host=host, Cookie=cookie, Origin="http://evil.example")
    assert status_of(access, wrong) == 403


def test_beyond_loopback_there_is_no_page_without_a_token(tmp_path: Path) -> None:
    with pytest.raises(ConsoleError, match="not loopback"):
        AccessControl("192.0.2.1", None)
    with pytest.raises(ValueError, match="token_file"):
        ConsoleParameters(address="192.0.2.1")
    with pytest.raises(ValueError, match="not an IP address"):
        ConsoleParameters(address="everywhere")
    assert ConsoleParameters(address="0.0.0.0", token_file=tmp_path / "t").address == "0.0.0.0"
    file = tmp_path / "token"
    with pytest.raises(ConsoleError, match="cannot be read"):
        read_token(file)
    file.write_text(TOKEN + "\n")
    file.chmod(0o644)
    with pytest.raises(ConsoleError, match="chmod 600"):
        read_token(file)
    file.chmod(0o600)
    assert read_token(file) == TOKEN
    for short in ("abc", "a b" * 10, "ä" * 20):
        file.write_text(short)
        with pytest.raises(ConsoleError, match="token_hex"):
            read_token(file)


@pytest.mark.parametrize("packed", [False, True])
def test_the_page_is_served_with_our_title_style_and_script(packed: bool) -> None:
    def answer(page: bytes, kind: str = "text/html; charset=utf-8") -> Response:
        body = gzip.compress(page) if packed else page
        headers = Headers({"Content-Type": kind, "Content-Length": str(len(body))})
        headers["Content-Encoding"] = "gzip" if packed else "identity"
        return Response(200, "OK", headers, body)

    served = inject_assets(answer(b"<html><head><title>x</title></head><body></body></html>"))
    assert served.headers.get_all("Content-Length") == [str(len(served.body))]
    page = gzip.decompress(served.body) if packed else bytes(served.body)
    head, _, rest = page.partition(b"</head>")
    assert re.findall(rb"<title>(.*?)</title>", head) == [b"flexsheet console"]
    assert b"--fs-text" in head
    assert b"E-STOP" in head
    assert rest == b"<body></body></html>"
    for other in (
        answer(b"no page"),
        answer(b"</head>", "image/png"),
        Response(401, "", Headers()),
    ):
        assert bytes(inject_assets(other).body) == bytes(other.body)


class LogLines(logging.Handler):
    """A log handler that stores the lines."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno >= logging.WARNING:
            self.lines += self.format(record).splitlines()


@pytest.fixture(scope="module")
def page_server() -> Iterator[tuple[int, LogLines]]:
    """Start a page, and yield its port and the lines of its log."""
    lines = LogLines()
    for logger in (make_page_logger(), logging.getLogger("websockets.server")):
        logger.addHandler(lines)
    server = start_server("127.0.0.1", 0, AccessControl("127.0.0.1", None), "test")
    yield server.get_port(), lines
    server.stop()
    for logger in (make_page_logger(), logging.getLogger("websockets.server")):
        logger.removeHandler(lines)


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
MALFORMED_REQUESTS = {
    "two hosts": b"GET / HTTP/1.1\r\n" + 2 * HOST + b"\r\n",
    "no host": b"GET / HTTP/1.1\r\n\r\n",
    "two origins": b"GET / HTTP/1.1\r\n" + HOST + 2 * b"Origin: http://127.0.0.1\r\n" + b"\r\n",
    "broken origin": b"GET / HTTP/1.1\r\n" + HOST + b"Origin: http://[\r\n\r\n",
    "two upgrades": b"GET / HTTP/1.1\r\n" + HOST + 2 * b"Upgrade: websocket\r\n" + b"\r\n",
    "long path": b"GET /" + 5000 * b"a" + b" HTTP/1.1\r\n" + HOST + b"\r\n",
    "no HTTP": b"\x16\x03\x01\x02\x00\x01\x00\r\n\r\n",
    "other method": b"POST / HTTP/1.1\r\n" + HOST + b"\r\n",
    "other version": b"GET / HTTP/9.9\r\n" + HOST + b"\r\n",
    "long line": 100_000 * b"x" + b"\r\n\r\n",
    "broken header": b"GET / HTTP/1.1\r\nno colon\r\n\r\n",
    "a body": b"GET / HTTP/1.1\r\n" + HOST + b"Content-Length: 3\r\n\r\nabc",
}


@pytest.mark.parametrize("name", MALFORMED_REQUESTS)
async def test_malformed_request_is_answered_with_a_plain_400(
    page_server: tuple[int, LogLines], name: str
) -> None:
    port, log = page_server
    logged = len(log.lines)
    status, headers = await answer_to(port, MALFORMED_REQUESTS[name])
    assert status == 400
    assert headers["x-frame-options"] == "DENY"
    assert len(log.lines) <= logged + 1, log.lines[logged:]
    assert (await answer_to(port, b"GET / HTTP/1.1\r\n" + HOST + b"\r\n"))[0] == 200


async def test_no_answer_may_be_shown_in_a_frame(page_server: tuple[int, LogLines]) -> None:
    port, _ = page_server
    for path, more, expected in (
        (b"/", b"", 200),
        (b"/none", b"", 404),
        (b"/", b"Origin: http://evil.example\r\n", 403),
        (b"/", b"Sec-Fetch-Dest: iframe\r\n", 403),
    ):
        request = b"GET " + path + b" HTTP/1.1\r\n" + HOST + more + b"\r\n"
        status, headers = await answer_to(port, request)
        assert status == expected
        assert headers["x-frame-options"] == "DENY"
        assert headers["content-security-policy"] == "frame-ancestors 'none'"


async def test_garbage_after_the_handshake_costs_one_log_line(
    page_server: tuple[int, LogLines],
) -> None:
    port, log = page_server
    logged = len(log.lines)
    protocol = websockets.Subprotocol(f"viser-v{viser.__version__}")
    async with websockets.connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol]) as socket:
        await socket.send(b"\xc1 no message")
        async with asyncio.timeout(DEADLINE_S):
            with suppress(websockets.ConnectionClosed):
                async for _ in socket:
                    pass
        assert socket.close_code == websockets.CloseCode.INTERNAL_ERROR
    assert len(log.lines) <= logged + 1, log.lines[logged:]
