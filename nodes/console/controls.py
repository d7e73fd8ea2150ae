"""What all of the page's tabs do with viser's controls.

Every callback runs on viser's own threads; it only hands on what was asked, by name, to the node.
Of viser's handles only what its stubs do not tell (that values can be set) is used: they are Any.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Ask = Callable[..., None]
"""ask(name, *values): what the viewer wants; may be called from any thread."""


def handing(ask: Ask, name: str, *values: Any) -> Callable[[Any], None]:
    """A callback that asks for this."""
    return lambda event: ask(name, *values)


def on_value(handle: Any, changed: Callable[[Any], None]) -> None:
    """Call with the value that a viewer has set; not with what the page is told to show.

    As a coroutine it runs on viser's loop, so that the values come in the order of the changes.
    """

    async def on_update(event: Any) -> None:
        if event.client_id is not None:
            changed(event.target.value)

    handle.on_update(on_update)


def show_value(handle: Any, value: Any) -> None:
    """Set a control's value where it shows another one."""
    if handle.value != value:
        handle.value = value


class Html:
    """A piece of HTML on the page, sent only where it has changed."""

    def __init__(self, gui: Any, html: str = "") -> None:
        self._handle, self._shown = gui.add_html(html), html

    def show(self, html: str) -> None:
        if self._shown != html:
            self._shown = self._handle.content = html
