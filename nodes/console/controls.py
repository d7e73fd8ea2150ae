"""Wrap the controls (GUI elements) of the library viser for all tabs of the console page.

Every callback runs on a thread of viser, and only passes a request to the node. Handles have the
type Any, because the type stubs of viser do not declare that values can be set.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Request = Callable[..., None]
"""A function request(name, *values) that passes a viewer's request to the node.

The function may be called from any thread."""


def make_callback(request: Request, name: str, *values: Any) -> Callable[[Any], None]:
    """Return a callback that sends a request with the given name and values."""
    return lambda event: request(name, *values)


def on_value(handle: Any, changed: Callable[[Any], None]) -> None:
    """Call `changed` with each value that a viewer sets, but not with values that the node sets."""

    # A coroutine runs in viser's event loop, so that values arrive in order.
    async def on_update(event: Any) -> None:
        if event.client_id is not None:
            changed(event.target.value)

    handle.on_update(on_update)


def show_value(handle: Any, value: Any) -> None:
    """Set the value of a control if it differs from the current value."""
    if handle.value != value:
        handle.value = value


class Html:
    """A block of HTML on the page that is transmitted only when it changes."""

    def __init__(self, gui: Any) -> None:
        self._handle, self._shown = gui.add_html(""), ""

    def show(self, html: str) -> None:
        if self._shown != html:
            self._shown = self._handle.content = html
