"""What is left to do when the site is built: `python -m website.finish site`.

Pages link to files of the project, as to `../launch/lab.yaml`; on the site these links lead to
copies.  And the generator has one script come from the network, which a script of ours replaces.
"""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path

COPIES = "project"
OUTWARD = re.compile(r'href="((?:\.\./)+)([^"#]+)"')
WORKERS_FOR_FILES = "https://unpkg.com/iframe-worker/shim"
OURS = "search-from-files.js"
FROM_THE_NETWORK = re.compile(r'(?:src|srcset)="https?://[^"]*"|<link[^>]*href="https?://[^"]*"')


class NetworkError(ValueError):
    """A page that would load something from the network."""


def finish(site: Path, project: Path) -> list[str]:
    """Lead links out of the site to copies, and scripts to ours; the files that were copied.

    FileNotFoundError for a link to a file that the project does not have; NetworkError where a page
    loads anything from elsewhere.
    """
    copied: set[str] = set()
    for page in site.rglob("*.html"):
        up = "../" * (len(page.relative_to(site).parts) - 1)

        def inward(link: re.Match[str], up: str = up) -> str:
            if len(link[1]) <= len(up):
                return link[0]
            copied.add(link[2])
            return f'href="{up}{COPIES}/{link[2]}.txt"'

        text = OUTWARD.sub(inward, page.read_text()).replace(WORKERS_FOR_FILES, up + OURS)
        if found := FROM_THE_NETWORK.search(text):
            raise NetworkError(f"{page}: {found[0]} comes from the network; put a copy into docs/")
        page.write_text(text)
    for name in copied:
        copy = site / COPIES / f"{name}.txt"
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(project / name, copy)
    return sorted(copied)


if __name__ == "__main__":
    print("copied:", *finish(Path(sys.argv[1]), Path.cwd()))
