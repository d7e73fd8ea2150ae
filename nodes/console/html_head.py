"""Add the console's title, style sheet and script to the HTML head of viser's page.

viser's page has the title "Viser", sliders without names, folders that cannot be opened by
keyboard, and labels with too little contrast. If the connection is lost, it shows only a red dot.
This module replaces the title. The files page.css and page.js correct the other defects. A page
without a head element is served unchanged.
"""

from __future__ import annotations

import gzip
import re
from functools import lru_cache
from pathlib import Path

from websockets.datastructures import Headers
from websockets.http11 import Response

HERE = Path(__file__).resolve().parent
HEAD_END = b"</head>"
VISER_TITLE = re.compile(rb"<title>[^<]*</title>")
TITLE = b"<title>flexsheet console</title>"


def inject_assets(response: Response) -> Response:
    """Inject title, style sheet and script into an HTML page; return other responses unchanged."""
    kind = response.headers.get("Content-Type", "")
    if response.status_code != 200 or not kind.startswith("text/html"):
        return response
    packed = response.headers.get("Content-Encoding") == "gzip"
    body = _with_head(bytes(response.body), packed)
    headers = Headers(response.headers)
    del headers["Content-Length"]
    headers["Content-Length"] = str(len(body))
    # In a frame, another page could hide the element that the user clicks.
    headers["X-Frame-Options"] = "DENY"
    return Response(response.status_code, response.reason_phrase, headers, body)


@lru_cache(maxsize=4)
def _with_head(body: bytes, packed: bool) -> bytes:
    page = gzip.decompress(body) if packed else body
    before, end, after = page.rpartition(HEAD_END)
    if not end:
        return body
    style, script = ((HERE / name).read_bytes() for name in ("page.css", "page.js"))
    ours = b"<style>" + style + b"</style><script>" + script + b"</script>"
    page = VISER_TITLE.sub(TITLE, before) + ours + end + after
    return gzip.compress(page) if packed else page
