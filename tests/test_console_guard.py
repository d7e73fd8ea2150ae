"""Who may see the page."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from nodes.console.dress import dressed
from nodes.console.guard import COOKIE, ConsoleError, Guard, read_token
from nodes.console.node import ConsoleParameters

Floats = NDArray[np.float64]
TOKEN = "0123456789abcdef0123"


def asked(path: str = "/", host: str = "127.0.0.1:8080", **headers: str) -> Request:
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    return Request(path, Headers({"Host": host, **named}))


def status_of(guard: Guard, request: Request) -> int:
    refused = guard.refusal(request)
    return 200 if refused is None else refused.status_code


def test_on_loopback_only_the_computers_own_pages_may_ask() -> None:
    guard = Guard("127.0.0.1", None)
    assert status_of(guard, asked()) == 200
    assert status_of(guard, asked(host="localhost:8080")) == 200
    assert status_of(guard, asked(host="[::1]:8080")) == 200
    assert status_of(guard, asked(Origin="http://127.0.0.1:8080", Upgrade="websocket")) == 200
    assert status_of(guard, asked(Origin="http://evil.example", Upgrade="websocket")) == 403
    assert status_of(guard, asked(Origin="null")) == 403
    assert status_of(guard, asked(host="evil.example:8080")) == 403, "a name bound to loopback"
    assert status_of(guard, asked(host="")) == 403
    assert status_of(guard, asked(host="[::1")) == 403


def test_with_a_token_who_does_not_know_it_is_sent_away() -> None:
    guard = Guard("192.0.2.1", TOKEN)
    host = "192.0.2.1:8080"
    assert status_of(guard, asked(host=host)) == 401
    assert status_of(guard, asked(f"/?token={TOKEN}x", host)) == 401
    assert status_of(guard, asked("/?token=", host)) == 401
    assert status_of(guard, asked("/?token=ü", host)) == 401
    welcome = guard.refusal(asked(f"/?token={TOKEN}", host))
    assert welcome is not None
    assert (welcome.status_code, welcome.headers["Location"]) == (303, "/")
    cookie = welcome.headers["Set-Cookie"].partition(";")[0]
    assert cookie == f"{COOKIE}={TOKEN}"
    assert status_of(guard, asked(host=host, Cookie=cookie)) == 200
    assert status_of(guard, asked(host=host, Cookie=f"{COOKIE}=guess")) == 401
    assert status_of(guard, asked(host=host, Cookie='a=b=;;"==')) == 401
    wrong = asked(host=host, Cookie=cookie, Origin="http://evil.example")
    assert status_of(guard, wrong) == 403


def test_beyond_loopback_there_is_no_page_without_a_token(tmp_path: Path) -> None:
    with pytest.raises(ConsoleError, match="beyond loopback"):
        Guard("192.0.2.1", None)
    with pytest.raises(ValueError, match="token_file"):
        ConsoleParameters(address="192.0.2.1")
    with pytest.raises(ValueError, match="no IP address"):
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
def test_the_page_is_served_with_our_style_and_script(packed: bool) -> None:
    def answer(page: bytes, kind: str = "text/html; charset=utf-8") -> Response:
        body = gzip.compress(page) if packed else page
        headers = Headers({"Content-Type": kind, "Content-Length": str(len(body))})
        headers["Content-Encoding"] = "gzip" if packed else "identity"
        return Response(200, "OK", headers, body)

    served = dressed(answer(b"<html><head><title>x</title></head><body></body></html>"))
    assert served.headers.get_all("Content-Length") == [str(len(served.body))]
    page = gzip.decompress(served.body) if packed else bytes(served.body)
    head, _, rest = page.partition(b"</head>")
    assert b"--fs-text" in head
    assert b"E-STOP" in head
    assert rest == b"<body></body></html>"
    for other in (
        answer(b"no page"),
        answer(b"</head>", "image/png"),
        Response(401, "", Headers()),
    ):
        assert bytes(dressed(other).body) == bytes(other.body)
