"""Entry of the `flexsheet` command and of every node's process.

ROS 2 has a Python package named `launch` too.  With foreign packages named `launch`, `nodes` or
`messages` on PYTHONPATH ours must win; so the first thing is to put our folder first.
"""

from __future__ import annotations

import atexit
import gc
import os
import sys

_HERE = os.path.dirname(os.path.abspath(__file__))
if sys.path[:1] != [_HERE]:
    sys.path.insert(0, _HERE)

NODE_FLAG = "--node"

# Nobody waits while all installed packages are asked for plugins of pydantic: ours has none.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")


def main() -> None:
    """Run the command, or with `--node CONFIG` one node (the launcher starts those)."""
    if len(sys.argv) == 3 and sys.argv[1] == NODE_FLAG:
        from launch.running.child import follow_launcher, give_way

        follow_launcher()
        give_way()
        from nodes.runner import main as run_node

        sys.exit(run_node(sys.argv[2]))
    _start_and_end_quickly()
    from launch.cli import main as run_command

    run_command()


def _start_and_end_quickly() -> None:
    """A command imports thousands of objects that stay; nobody should wait while they are searched
    for garbage: hardly ever while it starts, and not at all when it ends (a sixth of its time)."""
    gc.set_threshold(100_000)
    atexit.register(gc.freeze)


if __name__ == "__main__":
    main()
