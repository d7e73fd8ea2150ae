"""Write the pages and drawings of docs/ that are generated from the code.

python -m website.pages [DOCS]
"""

from __future__ import annotations

import sys
from pathlib import Path

from flexsheet.launch.plans.drawing import svg
from website import (
    apparatus_figure,
    arm_states_page,
    commands_page,
    errors_page,
    messages_page,
    parameters_page,
    registers_page,
    scene_page,
    tolerances_page,
    tracking_page,
)
from website.graph import DRAWINGS

DOCS = Path(__file__).resolve().parent.parent / "docs"


def generate(docs: Path) -> dict[Path, str]:
    """Return the contents of all generated files by their path relative to `docs`.

    docs: folder with apparatus.md, arms.md, modbus.md and tracking.md, which are generated in part.
    """
    return {
        Path("messages.md"): messages_page.reference(),
        Path("cli.md"): commands_page.reference(),
        Path("parameters.md"): parameters_page.reference(),
        Path("errors.md"): errors_page.reference(),
        Path("scene-file.md"): scene_page.reference(),
        Path("arms.md"): arm_states_page.page((docs / "arms.md").read_text(encoding="utf-8")),
        Path("modbus.md"): registers_page.page((docs / "modbus.md").read_text(encoding="utf-8")),
        Path("apparatus.md"): tolerances_page.page(
            (docs / "apparatus.md").read_text(encoding="utf-8")
        ),
        Path("tracking.md"): tracking_page.page(
            (docs / "tracking.md").read_text(encoding="utf-8"), docs / "charts/tracking-regret.json"
        ),
        **{Path("images") / name: svg(picture) for name, picture in DRAWINGS.items()},
        Path("images") / "apparatus.svg": apparatus_figure.svg(),
    }


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else DOCS
    for path, text in generate(folder).items():
        (folder / path).write_text(text, encoding="utf-8")
