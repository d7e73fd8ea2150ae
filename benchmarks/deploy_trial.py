"""Follow docs/deploy.md on three simulated computers: `python -m benchmarks.deploy_trial`.

The computers are three network namespaces at a switch, with separate directories for /etc,
/opt/flexsheet, /var/lib, /run, home and runs; this requires root. The commands of the page's
`console` blocks are typed in order into one shell per computer. The result is the exit code of each
command and, from the main computer's bag, whether both arms followed the stroke.

A namespace lacks some programs, which are substituted: the packages of this Python (so that `make
setup` finds them), and `ssh`, `scp`, `sudo`, `nano` and `systemctl` by small programs in
`benchmarks/standins`.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from flexsheet.launch.running.runs import root as runs_root
from flexsheet.messages.bag import BagReader
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import ArmState, SheetTarget, TwinFinger
from flexsheet.nodes.models.rigid import pose_matrix
from tests.lab import ROOT, Network, missing

PAGE = ROOT / "docs" / "deploy.md"
HOSTS = ("main", "left", "right")
ADDRESSES = {"main": "192.0.2.10", "left": "192.0.2.11", "right": "192.0.2.12"}
"""The addresses of the computers, which differ from those in launch/three.yaml."""

PROMPT = re.compile(rf"(each|{'|'.join(HOSTS)})\$ (.*)")
EXIT_CODE = re.compile(r"# .*exit code (\d+)")
SYSTEM_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
READY_S, COMMAND_S = 300.0, 300.0
FOLLOWED_M, FOLLOWED_SHARE = 0.005, 0.6
"""The maximum distance between sheet and target in metres for arms that follow, and the minimum
fraction of the stroke in which both arms follow. One busy computer simulates three computers.
"""

MOVED_M = 0.005
"""The minimum travel of the sheet's centre in metres; the stroke of the page moves it by 7 mm."""


@dataclass(frozen=True, slots=True)
class Step:
    """A command in a console block of the page: its computers, text and expected exit code."""

    line: int
    hosts: tuple[str, ...]
    command: str
    code: int


@dataclass(frozen=True, slots=True)
class StepResult:
    """The result of a step on one computer."""

    line: int
    host: str
    command: str
    code: int
    wanted: int
    took_s: float
    words: str


def steps(text: str) -> Iterator[Step]:
    """Return the commands in a page's console blocks.

    Raises ValueError for a line without a prompt.
    """
    inside = False
    for number, line in enumerate(text.splitlines(), start=1):
        if line.startswith("```"):
            inside = not inside and line == "```console"
        elif inside:
            found = PROMPT.fullmatch(line)
            if found is None:
                raise ValueError(
                    f"line {number} has no prompt: expected each$, {'$, '.join(HOSTS)}$"
                )
            code = EXIT_CODE.search(found[2])
            hosts = HOSTS if found[1] == "each" else (found[1],)
            yield Step(number, hosts, found[2], int(code[1]) if code else 0)


class Computer:
    """A shell in a network namespace with separate directories."""

    def __init__(self, name: str, space: str, folder: Path) -> None:
        self.name, self.folder, self._space = name, folder / name, space
        self._shell: asyncio.subprocess.Process

    async def start(self) -> None:
        home = self.folder / "home"
        for part in ("home", "users", "opt", "var", "cache", "run", "runs"):
            (self.folder / part).mkdir(parents=True)
        clone = self.folder.parent / "clone"
        safe = f"[safe]\n\tdirectory = {clone}\n\tdirectory = {clone}/.git\n"
        (home / ".gitconfig").write_text(safe)
        shutil.copytree("/etc", self.folder / "etc", symlinks=True)
        mounts = {
            "etc": "/etc", "opt": "/opt/flexsheet", "var": "/var/lib", "cache": "/var/cache",
            "users": "/home", "run": "/run", "runs": str(runs_root()),
        }  # fmt: skip
        lent = {sysconfig.get_path("purelib"): "packages", sys.base_prefix: "python", ROOT: "clone"}
        script = [f"mount --bind {what} {self.folder.parent / to}" for what, to in lent.items()]
        script += [f"mount --bind {self.folder / what} {to}" for what, to in mounts.items()]
        path = f"{self.folder.parent / 'clone/benchmarks/standins'}:{SYSTEM_PATH}"
        environment = {
            "HOME": str(home), "USER": "root", "PATH": path, "LANG": "C.UTF-8",
            "TRIAL": str(self.folder.parent), "OPENBLAS_NUM_THREADS": "1",
            # Other users cannot read the library of a Python in a user's home directory.
            "LD_LIBRARY_PATH": str(self.folder.parent / "python/lib"),
        }  # fmt: skip
        self._shell = await asyncio.create_subprocess_exec(
            "ip", "netns", "exec", self._space, "unshare", "--mount", "bash", "-c",
            f"set -e; {'; '.join(script)}; cd; exec bash",
            env=environment, stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT, limit=1 << 22, cwd="/",
        )  # fmt: skip
        (self.folder / "pid").write_text(str(self._shell.pid))
        await self.type("set -m")

    async def type(self, command: str) -> tuple[int, str]:
        """Run a command, and return its exit code and output."""
        assert self._shell.stdin is not None
        assert self._shell.stdout is not None
        self._shell.stdin.write(f"{command}\nprintf '\\001%d\\n' $?\n".encode())
        words = []
        async with asyncio.timeout(COMMAND_S):
            while line := (await self._shell.stdout.readline()).decode(errors="replace"):
                before, mark, code = line.partition("\x01")
                words.append(before)
                if mark:
                    return int(code), "".join(words)
        raise RuntimeError(f"the shell of {self.name} has ended: {''.join(words)}")

    async def follow(self, command: str) -> tuple[int, str]:
        """Run a command of the page.

        A launch runs in the background, and the function waits until all nodes are ready.
        """
        command = re.sub(r"\bNAME\b", self.name, command).replace("URL", "$TRIAL/clone")
        if command == "make setup":
            self._lend_packages()
        if command == "^C":
            return await self.type("kill -INT $LAUNCHED && wait $LAUNCHED")
        if command.startswith("flexsheet launch") and "--dry-run" not in command:
            log = self.folder / "launch.log"
            log.touch()
            await self.type(f"{command} > {log} 2>&1 & LAUNCHED=$!")
            end_s = time.monotonic() + READY_S
            while time.monotonic() < end_s:
                if "nodes are ready" in log.read_text():
                    return 0, log.read_text()
                code, _ = await self.type("kill -0 $LAUNCHED")
                if code:
                    break
                await asyncio.sleep(0.1)
            return 1, log.read_text()
        return await self.type(command)

    def _lend_packages(self) -> None:
        """Create a virtual environment that contains the locked packages."""
        trial, venv = self.folder.parent, self.folder / "opt" / ".venv"
        home = trial / "python" / "bin"
        site = venv / f"lib/python{sys.version_info[0]}.{sys.version_info[1]}/site-packages"
        site.mkdir(parents=True)
        (venv / "bin").mkdir()
        (venv / "pyvenv.cfg").write_text(f"home = {home}\ninclude-system-site-packages = false\n")
        (site / "lent.pth").write_text(f"{trial / 'packages'}\n")
        python = f"python{sys.version_info[0]}.{sys.version_info[1]}"
        (venv / "bin/python").symlink_to(home / python)
        (venv / "bin/activate").write_text("PATH=/opt/flexsheet/.venv/bin:$PATH\n")
        (venv / "bin/pip").write_text('#!/bin/sh\nexec "${0%/*}/python" -m pip "$@"\n')
        (venv / "bin/pip").chmod(0o755)

    async def close(self) -> None:
        assert self._shell.stdin is not None
        self._shell.stdin.write(b"kill -INT $LAUNCHED 2>/dev/null; wait; exit\n")
        self._shell.stdin.close()
        try:
            async with asyncio.timeout(40.0):
                await self._shell.wait()
        except TimeoutError:
            self._shell.kill()
            await self._shell.wait()


@dataclass(frozen=True, slots=True)
class Stroke:
    """Measures of how well the arms follow the finger's path.

    following: fraction of the planner's messages at which both arms followed.
    apart_m: 95 % quantile of the distance between the sheet's centre and its target.
    travel_m: travel of the sheet's centre.
    """

    seconds: float
    following: float
    apart_m: float
    travel_m: float

    def problems(self) -> list[str]:
        found = []
        if self.following < FOLLOWED_SHARE:
            found.append(f"the arms followed {self.following:.0%} of the stroke only")
        if not self.apart_m < FOLLOWED_M:
            found.append(f"the sheet was {self.apart_m * 1e3:.1f} mm from where it was wanted")
        if self.travel_m < MOVED_M:
            found.append(f"the sheet moved by {self.travel_m * 1e3:.1f} mm only")
        return found


def evaluate_stroke(bag: Path) -> Stroke:
    """Evaluate both arms while the simulated finger moves along its path."""
    reader = BagReader(bag, ["scene", "arm_left", "arm_right", "sheet_target", "twin/finger"])
    states: dict[str, list[tuple[int, ArmState]]] = {"left": [], "right": []}
    targets, path, scene = [], [], None
    for _, message, header, _ in reader:
        match message:
            case Scene():
                scene = message
            case ArmState():
                states[message.side].append((header.source_ns, message))
            case SheetTarget():
                targets.append((message.valid_at_ns, message.world_from_sheet[:3, 3]))
            case TwinFinger():
                if message.path_label and not message.path_done and message.path_time_s > 0:
                    path.append(header.source_ns)
    if scene is None or not path or not targets or not all(states.values()):
        raise ValueError(f"{bag}: contains no stroke")
    begin, end = path[0], path[-1]
    times = np.array([at for at, _ in targets if begin <= at <= end])
    wanted = np.array([centre for at, centre in targets if begin <= at <= end])
    edges, follow = [], np.ones(len(times), dtype=bool)
    for side, printed in states.items():
        mount = getattr(scene.arms, side).flange_from_edge
        flange_from_edge = pose_matrix(mount)
        at = np.array([stamp for stamp, _ in printed])
        edge = np.array([(one.world_from_flange @ flange_from_edge)[:3, 3] for _, one in printed])
        edges.append(np.column_stack([np.interp(times, at, edge[:, k]) for k in range(3)]))
        modes = np.array([one.mode == "follow" for _, one in printed])
        follow &= modes[np.searchsorted(at, times).clip(max=len(at) - 1)]
    centre = (edges[0] + edges[1]) / 2
    apart = np.linalg.norm(centre - wanted, axis=1)[follow]
    return Stroke(
        seconds=(end - begin) * 1e-9,
        following=float(np.mean(follow)),
        apart_m=float(np.quantile(apart, 0.95)) if len(apart) else np.inf,
        travel_m=float(np.ptp(centre, axis=0).max()),
    )


async def try_page(folder: Path, until: int) -> list[StepResult]:
    """Run the commands of the page up to a line number.

    The function stops at an unexpected exit code.
    """
    done: list[StepResult] = []
    async with Network(f"fs{os.getpid()}", ADDRESSES) as network:
        computers = {name: Computer(name, network.space(name), folder) for name in HOSTS}
        for computer in computers.values():
            await computer.start()
        try:
            for step in steps(PAGE.read_text()):
                if step.line > until:
                    break
                done += await asyncio.gather(
                    *(_follow(computers[host], step) for host in step.hosts)
                )
                if any(one.code != one.wanted for one in done):
                    break
        finally:
            await asyncio.gather(*(computer.close() for computer in computers.values()))
    return done


async def _follow(computer: Computer, step: Step) -> StepResult:
    began_s = time.monotonic()
    code, words = await computer.follow(step.command)
    took_s = time.monotonic() - began_s
    one = StepResult(step.line, computer.name, step.command, code, step.code, took_s, words)
    print(f"{step.line:4} {computer.name:>5}$ {step.command[:90]}  [{code}, {took_s:.1f} s]",
          file=sys.stderr, flush=True)  # fmt: skip
    if code != step.code:
        print(words, file=sys.stderr)
    return one


def prepare(folder: Path) -> None:
    """Create the folder of substitutes that the computers share."""
    folder.chmod(0o755)
    for name in ("packages", "python", "clone"):
        (folder / name).mkdir()
    (folder / "addresses.json").write_text(json.dumps(ADDRESSES))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--until", type=int, default=10**9, metavar="LINE", help="last line to run")
    parser.add_argument("--keep", action="store_true", help="do not delete the folder")
    given = parser.parse_args()
    if why := missing():
        print(f"skipped: {why}", file=sys.stderr)
        return 0
    folder = Path(tempfile.mkdtemp(prefix="fs-", dir="/tmp"))
    made = [path for path in (Path("/opt/flexsheet"), runs_root()) if not path.exists()]
    try:
        for path in made:
            path.mkdir(parents=True, mode=0o700)
        prepare(folder)
        done = asyncio.run(try_page(folder, given.until))
        problems = [f"{PAGE.name}:{one.line}: {one.host}: {one.command}: exit code {one.code}"
                    for one in done if one.code != one.wanted]  # fmt: skip
        stroke = None
        bags = sorted((folder / "main/opt/runs").glob("*.mcap"))
        if not problems and bags:
            stroke = evaluate_stroke(bags[0])
            problems += stroke.problems()
        elif not problems:
            problems.append("no stroke was recorded")
    finally:
        for path in made:
            path.rmdir()
        if given.keep:
            print(f"kept: {folder}", file=sys.stderr)
        else:
            shutil.rmtree(folder)
    commit = subprocess.run(
        ["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"],
        capture_output=True, text=True, check=False,
    ).stdout.strip()  # fmt: skip
    report = {
        "commit": commit,
        "commands": len(done),
        "took_s": sum(one.took_s for one in done),
        "stroke": asdict(stroke) if stroke else None,
        "problems": problems,
    }
    print(json.dumps(report, indent=1))
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
