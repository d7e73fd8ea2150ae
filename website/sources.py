"""Files of the project that pages link to, put beside the site: `python -m website.sources site`.

A page links to `../launch/lab.yaml`, which is right in the project and wherever its repository is
looked at.  On the site such links lead to copies.
"""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path

COPIES = "project"
OUTWARD = re.compile(r'href="((?:\.\./)+)([^"#]+)"')


def copy_sources(site: Path) -> list[str]:
    """Copy what is linked out of the site into it, as text, and let links lead there.

    FileNotFoundError for a link to a file that the project does not have.
    """
    root, copied = Path.cwd(), set()
    for page in site.rglob("*.html"):
        depth = len(page.relative_to(site).parts)

        def inward(link: re.Match[str], depth: int = depth) -> str:
            ups, target = link[1].count("../"), link[2]
            if ups < depth:
                return link[0]
            copied.add(target)
            return f'href="{"../" * (depth - 1)}{COPIES}/{target}.txt"'

        text = page.read_text()
        changed = OUTWARD.sub(inward, text)
        if changed != text:
            page.write_text(changed)
    for target in copied:
        goal = site / COPIES / f"{target}.txt"
        goal.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(root / target, goal)
    return sorted(copied)


if __name__ == "__main__":
    print("copied:", *copy_sources(Path(sys.argv[1])))
