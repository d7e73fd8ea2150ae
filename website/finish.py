"""Finish the built site: `python -m website.finish site`.

Links to files of the project, such as `../launch/lab.yaml`, are changed to copies of these files.
The only script from the network is replaced by a local one.
"""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path

COPIES = "project"
OUTWARD_LINK = re.compile(r'href="((?:\.\./)+)([^"#]+)"')
WORKER_SHIM_URL = "https://unpkg.com/iframe-worker/shim"
LOCAL_SHIM = "search-from-files.js"
NETWORK_RESOURCE = re.compile(r'(?:src|srcset)="https?://[^"]*"|<link[^>]*href="https?://[^"]*"')


class NetworkError(ValueError):
    """Raised if a page loads a resource from the network."""


def finish(site: Path, project: Path) -> list[str]:
    """Copy linked files of the project into the site, correct the links, and return the files.

    Raises FileNotFoundError for a link to a missing file, and NetworkError for a page that loads a
    resource from the network.
    """
    copied: set[str] = set()
    for page in site.rglob("*.html"):
        up = "../" * (len(page.relative_to(site).parts) - 1)

        def link_to_copy(link: re.Match[str], up: str = up) -> str:
            if len(link[1]) <= len(up):
                return link[0]
            copied.add(link[2])
            return f'href="{up}{COPIES}/{link[2]}.txt"'

        text = OUTWARD_LINK.sub(link_to_copy, page.read_text()).replace(
            WORKER_SHIM_URL, up + LOCAL_SHIM
        )
        if found := NETWORK_RESOURCE.search(text):
            raise NetworkError(f"{page}: {found[0]} loads from the network; add a copy to docs/")
        page.write_text(text)
    for name in copied:
        copy = site / COPIES / f"{name}.txt"
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(project / name, copy)
    return sorted(copied)


if __name__ == "__main__":
    print("copied:", *finish(Path(sys.argv[1]), Path.cwd()))
