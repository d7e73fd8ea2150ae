"""Wrap viser's controls (GUI elements) for all tabs of the page.

Every callback runs on viser's own threads and only passes a request to the node. viser's type stubs
do not declare that values can be set, so handles have the type Any.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Request = Callable[..., None]
"""Function request(name, *values), which passes a viewer's request to the node from any thread."""


def make_callback(request: Request, name: str, *values: Any) -> Callable[[Any], None]:
    """Return a callback that makes the request `name` with these values."""
    return lambda event: request(name, *values)


def on_value(handle: Any, changed: Callable[[Any], None]) -> None:
    """Call `changed` with each value that a viewer sets, but not with values that the page sets.

    The callback is a coroutine on viser's loop, so that values arrive in order.
    """

    async def on_update(event: Any) -> None:
        if event.client_id is not None:
            changed(event.target.value)

    handle.on_update(on_update)


def show_value(handle: Any, value: Any) -> None:
    """Set the value of a control if it differs."""
    if handle.value != value:
        handle.value = value


class Html:
    """Piece of HTML on the page, which is sent only when it changes."""

    def __init__(self, gui: Any, html: str = "") -> None:
        self._handle, self._shown = gui.add_html(html), html

    def show(self, html: str) -> None:
        if self._shown != html:
            self._shown = self._handle.content = html
