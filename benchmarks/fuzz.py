"""Fuzz the parsers of external data: `make fuzz`, or

python -m benchmarks.fuzz [TARGET ...] [--seconds 300] [--corpus FOLDER]

Each target (`benchmarks.fuzz_targets`) runs in a separate process, guided by the coverage of this
code and of the libraries below it (atheris: the extra `fuzz`). The inputs start from valid
examples, and mutators preserve part of their structure. Findings are in the corpus folder as
`TARGET/crash-...`; `python -m benchmarks.fuzz TARGET --again FILE` repeats one.
"""

from __future__ import annotations

import argparse
import json
import random
import re
import subprocess
import sys
import warnings
from importlib import import_module
from pathlib import Path
from typing import Any

MEMORY_MIB = 2048
MAX_S = 20
FOUND = ("crash", "oom", "timeout")
"""The name prefixes of the files in which atheris stores findings."""

MAX_BYTES = 1 << 20
MODULES = {
    "wire": ("flexsheet.messages.wire", "flexsheet.messages.bus", "flexsheet.messages.arrays"),
    "bag": ("flexsheet.messages.bag", "flexsheet.messages.wire"),
    "launch": ("flexsheet.launch.plans.documents", "flexsheet.launch.plans.plan"),
    "scene": (
        "flexsheet.launch.plans.documents",
        "flexsheet.launch.objects.meshes",
        "flexsheet.launch.objects.textures",
        "flexsheet.messages.scene",
    ),
    "mesh": ("flexsheet.launch.objects.meshes", "flexsheet.nodes.models.shapes.triangles"),
    "modbus": ("flexsheet.nodes.arm_bridge.modbus", "flexsheet.nodes.twin.arms", "pymodbus"),
    "mxt": ("flexsheet.nodes.arm_bridge.mxt", "flexsheet.nodes.twin.mxt_controller"),
}
"""Modules to instrument for coverage, by target."""

TARGETS = tuple(MODULES)


def fuzz(name: str, corpus: Path, seconds: float) -> None:
    """Run one target in this process until atheris ends it."""
    import atheris

    with atheris.instrument_imports(include=list(MODULES[name])):
        for module in MODULES[name]:
            import_module(module)
        from benchmarks.fuzz_targets import TARGETS as targets
        from benchmarks.fuzz_targets import import_nodes
    import_nodes()
    target = targets[name]
    warnings.simplefilter("ignore")
    for number, seed in enumerate(target.seeds()):
        target.check(seed)
        (corpus / f"seed-{number}").write_bytes(seed)

    def mutate(data: bytes, most_bytes: int, seed: int) -> bytes:
        chance = random.Random(seed)
        if chance.random() < 0.2:
            return bytes(atheris.Mutate(data, most_bytes))
        for _ in range(chance.choice((1, 1, 2, 4))):
            data = target.mutate(data, chance)
        return data[:most_bytes]

    def run(data: bytes) -> None:
        target.check(data)

    arguments = [
        sys.argv[0],
        str(corpus),
        f"-max_total_time={seconds:.0f}",
        f"-artifact_prefix={corpus}/",
        f"-rss_limit_mb={MEMORY_MIB}",
        f"-timeout={MAX_S}",
        f"-max_len={MAX_BYTES}",
        "-print_final_stats=1",
        "-verbosity=1",
    ]
    atheris.Setup(arguments, run, custom_mutator=mutate)
    atheris.Fuzz()


def findings_in(folder: Path) -> set[str]:
    """Return the files with findings in a target's folder, from this run or an earlier one."""
    return {str(one) for kind in FOUND for one in folder.glob(f"{kind}-*")}


def fuzz_in_process(name: str, corpus: Path, seconds: float) -> dict[str, Any]:
    """Run one target in a separate process, and return its last output."""
    folder = corpus / name
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "log.txt"
    before = findings_in(folder)
    with log.open("wb") as written:
        command = [sys.executable, "-m", "benchmarks.fuzz", name, "--here"]
        command += ["--corpus", str(corpus), "--seconds", str(seconds)]
        code = subprocess.run(command, stdout=written, stderr=written, check=False).returncode
    text = log.read_text(errors="replace")
    runs = re.findall(r"^#(\d+)\s", text, re.MULTILINE)
    reached = re.findall(r"cov: (\d+)", text)
    return {
        "target": name,
        "runs": int(runs[-1]) if runs else 0,
        "reached": [int(reached[0]), int(reached[-1])] if reached else None,
        "exit_code": code,
        "found": sorted(findings_in(folder) - before),
        "log": str(log),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=", ".join(TARGETS))
    parser.add_argument("--seconds", type=float, default=300.0, help="duration per target, s")
    parser.add_argument("--corpus", type=Path, default=Path("runs/fuzz"))
    parser.add_argument("--again", type=Path, metavar="FILE", help="run one input of the target")
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    for name in given.targets:
        if name not in TARGETS:
            parser.error(f'no target "{name}"; there are: {", ".join(TARGETS)}')
    if given.again is not None:
        from benchmarks.fuzz_targets import TARGETS as targets

        (name,) = given.targets
        print("taken" if targets[name].check(given.again.read_bytes()) else "refused")
        return 0
    corpus = given.corpus.resolve()
    if given.here:
        (name,) = given.targets
        fuzz(name, corpus / name, given.seconds)
        return 0
    bad = False
    for name in given.targets or TARGETS:
        result = fuzz_in_process(name, corpus, given.seconds)
        print(json.dumps(result), flush=True)
        bad |= bool(result["found"]) or result["exit_code"] != 0
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
