"""An e-stop as a file: what a launcher that is started anew must know though all who knew are gone.

Only a reset removes it.  What cannot be read counts as a stop.  A file belongs to the arms that it
stops, so that graphs of the same arms share it, whatever their launch files, and others do not.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path

from flexsheet.messages.types import EStop

STATE_VARIABLE = "FLEXSHEET_STATE"
"""Environment variable that moves the directory of what outlives a computer's start."""


def directory() -> Path:
    """Where this user's launchers write what they must not forget."""
    given = os.environ.get(STATE_VARIABLE)
    if given:
        return Path(given)
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "flexsheet"


class EStopFile:
    """The e-stop that a host's launcher keeps.

    arms: where the arms are reached.
    """

    def __init__(self, host: str, arms: Sequence[str]) -> None:
        which = hashlib.sha256("\n".join(sorted(arms)).encode()).hexdigest()[:8]
        self.path = directory() / f"estop-{host}-{which}.json"

    def read(self) -> EStop | None:
        """The e-stop that was engaged; None where none is."""
        try:
            reason = json.loads(self.path.read_text())["reason"]
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            reason = f"{self.path} cannot be read ({error}), which may have held one"
        return EStop(engaged=True, reason=str(reason))

    def write(self, estop: EStop) -> None:
        """Write it down for good, also should the power fail next; OSError."""
        self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        part = self.path.with_suffix(".part")
        with part.open("w") as file:
            json.dump({"reason": estop.reason}, file)
            file.flush()
            os.fsync(file.fileno())
        part.rename(self.path)
        self._sync_folder()

    def remove(self) -> None:
        """It was reset; OSError."""
        self.path.unlink(missing_ok=True)
        if self.path.parent.is_dir():
            self._sync_folder()

    def _sync_folder(self) -> None:
        folder = os.open(self.path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
