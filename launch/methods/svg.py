"""Save figures as SVG files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING

from flexsheet.messages.files import write_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INK = "#1f2328"
COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#56b4e9", "#8c6bb1", "#7f7f7f")
"""The colours of lines, adapted from those of Okabe and Ito for colour vision deficiency."""


@contextmanager
def page_style() -> Iterator[None]:
    """Set a matplotlib style with these colours, in which equal figures give equal files."""
    import matplotlib as mpl
    from matplotlib.rcsetup import cycler

    with mpl.rc_context({"axes.prop_cycle": cycler(color=COLOURS), "svg.hashsalt": "flexsheet"}):
        yield


def save_svg(figure: Figure, path: Path) -> None:
    """Write a figure to an SVG file."""
    text = StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    write_file(path, text.getvalue())
