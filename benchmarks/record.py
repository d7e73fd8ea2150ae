"""Record the JSON output of a command in docs/results, with machine, commit and date.

python -m benchmarks.record NAME -- COMMAND...

Writes docs/results/NAME.json.  `make pages` then updates the figures of the pages.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from flexsheet.launch.methods.results import machine_name, replace_non_finite
from flexsheet.launch.running.commit import read_commit

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "docs" / "results"
MISSED_EXIT_CODE = 1
"""The exit code of a measurement that is complete, but exceeds a limit."""


def record(name: str, command: Sequence[str], folder: Path = RESULTS) -> Path:
    """Run a command that prints JSON, and write the output to a file with machine and commit.

    The command may exit with 0 or `MISSED_EXIT_CODE`. Raises CalledProcessError for another exit
    code, and JSONDecodeError for an output that is not JSON.
    """
    load = os.getloadavg()[0]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode not in (0, MISSED_EXIT_CODE):
        done.check_returncode()
    record = {
        "command": shlex.join(command),
        "machine": machine_name(),
        "load": round(load, 2),
        "code": {"commit": read_commit()},
        "date": datetime.now(UTC).date().isoformat(),
        "results": replace_non_finite(json.loads(done.stdout)),
    }
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.json"
    path.write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return path


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("name", metavar="NAME")
    parser.add_argument("command", metavar="COMMAND", nargs="+")
    given = parser.parse_args()
    print(record(given.name, given.command), file=sys.stderr)
