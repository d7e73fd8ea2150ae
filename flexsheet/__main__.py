"""Run the `flexsheet` command or, with `--node CONFIG`, a process with nodes.

The first statements give SIGINT its default action, which ends a process without a traceback.
Python's own handler would print a traceback during imports, and its exception is lost in callbacks
of the garbage collector. `launch.cli` restores the handler for commands that clean up. Graphs and
nodes handle SIGINT in their event loop (`nodes.signals`). SIGINT is enabled even if the parent
process ignores or blocks it (docs/nodes-and-processes.md).
"""

from __future__ import annotations

# The built-in module: `signal` itself imports others first.
from _signal import (  # type: ignore[import-not-found]  # typeshed has no stub of it
    SIG_DFL,
    SIG_UNBLOCK,
    SIGINT,
    pthread_sigmask,
    signal,
)

signal(SIGINT, SIG_DFL)
pthread_sigmask(SIG_UNBLOCK, {SIGINT})

# ruff: noqa: E402 - see above
import atexit
import gc
import os
import sys

# Importing `typing` would lengthen the start.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import NoReturn

NODE_FLAG = "--node"

# Pydantic would search every installed package for plugins; none is used.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")


def main() -> None:
    """Run the `flexsheet` command, or a process with nodes if the arguments are `--node CONFIG`."""
    if len(sys.argv) == 3 and sys.argv[1] == NODE_FLAG:
        _run_node(sys.argv[2])
    _avoid_garbage_collection()
    if sys.argv[1:3] == ["arms", "stop"]:
        # Importing the command line takes several times longer than sending the stop.
        from flexsheet.launch.running.stopping import send_early

        send_early(sys.argv[3:])
    from flexsheet.launch.cli import main as run_command

    run_command()


def _run_node(config_file: str) -> NoReturn:
    from flexsheet.launch.running.child import apply_niceness, exit_with_parent

    exit_with_parent()
    apply_niceness()
    _shorten_imports()
    from flexsheet.nodes.runner import main as run_node

    sys.exit(run_node(config_file))


def _shorten_imports() -> None:
    """Make imports faster: disable garbage collection, and import structlog without rich."""
    gc.disable()
    if "structlog" in sys.modules:
        return
    # Without `rich`, structlog leaves out its coloured tracebacks, which nodes do not print.
    sys.modules["rich"] = None  # type: ignore[assignment]  # makes `import rich` fail
    import structlog  # noqa: F401

    del sys.modules["rich"]


def _avoid_garbage_collection() -> None:
    """Run garbage collections rarely, and none at exit. This saves a sixth of a command's time."""
    gc.set_threshold(100_000)
    atexit.register(gc.freeze)


if __name__ == "__main__":
    main()
