"""Store an engaged emergency stop (e-stop) in a file, so that it survives a restart of a launcher.

Only a reset of the e-stop removes the file. A file that cannot be read is treated as an e-stop. The
file name contains a hash of the arms' addresses. Graphs therefore share the file only if they use
the same arms.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path

from flexsheet.messages.types import EStop

STATE_VARIABLE = "FLEXSHEET_STATE"
"""The environment variable that replaces the default folder of persistent state."""


def directory() -> Path:
    """Return this user's folder for data that must survive a restart of the computer."""
    configured = os.environ.get(STATE_VARIABLE)
    if configured:
        return Path(configured)
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "flexsheet"


class EStopFile:
    """A file that stores the e-stop of one host.

    arms: network addresses of the arms of the graph.
    """

    def __init__(self, host: str, arms: Sequence[str]) -> None:
        digest = hashlib.sha256("\n".join(sorted(arms)).encode()).hexdigest()[:8]
        self.path = directory() / f"estop-{host}-{digest}.json"

    def read(self) -> EStop | None:
        """Return the stored e-stop, or None if no e-stop is stored.

        If the file cannot be read, return an e-stop.
        """
        try:
            reason = json.loads(self.path.read_text())["reason"]
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            reason = f"{self.path} cannot be read ({error}) and may contain an e-stop"
        return EStop(engaged=True, reason=str(reason))

    def write(self, estop: EStop) -> None:
        """Store the e-stop, so that it survives a power failure. Raises OSError if this fails."""
        self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        part = self.path.with_suffix(".part")
        with part.open("w") as file:
            json.dump({"reason": estop.reason}, file)
            file.flush()
            os.fsync(file.fileno())
        part.rename(self.path)
        self._sync_folder()

    def remove(self) -> None:
        """Remove the file after a reset of the e-stop. Raises OSError if this fails."""
        self.path.unlink(missing_ok=True)
        if self.path.parent.is_dir():
            self._sync_folder()

    def _sync_folder(self) -> None:
        folder = os.open(self.path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
