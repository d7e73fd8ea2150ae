"""Save figures as SVG files that are legible on light and dark pages."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flexsheet.messages.files import write_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INK, DARK_INK = "#1f2328", "#e6edf3"
"""The colours of axes and text on light and on dark pages."""

COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#56b4e9", "#8c6bb1", "#7f7f7f")
"""The colours of lines, adapted from those of Okabe and Ito for colour vision deficiency."""

_STYLE: dict[Any, Any] = {
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "grid.color": INK,
    "hatch.color": INK,
    "legend.edgecolor": INK,
    "legend.facecolor": "none",
    "legend.framealpha": 0.0,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    # With a fixed salt, equal figures give equal files.
    "svg.hashsalt": "flexsheet",
}

_DARK = f"""<style>
@media (prefers-color-scheme: dark) {{
 [style*="stroke: {INK}"] {{ stroke: {DARK_INK} !important; }}
 [style*="fill: {INK}"] {{ fill: {DARK_INK} !important; }}
}}
</style>
"""


@contextmanager
def page_style() -> Iterator[None]:
    """Set a matplotlib style whose colours `save_svg` can replace on dark pages."""
    import matplotlib as mpl
    from matplotlib.rcsetup import cycler

    style = _STYLE | {"axes.prop_cycle": cycler(color=COLOURS)}
    with mpl.rc_context(style):
        yield


def render_svg(figure: Figure) -> str:
    """Return the figure as SVG text with transparent background, and light text on dark pages."""
    text = StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    head, tag, rest = text.getvalue().partition("<defs>")
    return f"{head}{_DARK}{tag}{rest}"


def save_svg(figure: Figure, path: Path) -> None:
    """Write a figure to an SVG file that is legible on light and dark pages."""
    write_file(path, render_svg(figure))
