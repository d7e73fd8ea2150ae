"""What the recorder is told by the launch file."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from flexsheet.nodes.node import NodeParameters

RUN_FILES = tuple(
    Path("@run") / name for name in ("launch.yaml", "scene.yaml", "plan.json", "git.json")
)


class RecorderParameters(NodeParameters):
    """Which topics go to which bag."""

    bag: Path = Field(description="file to write; %Y%m%d-%H%M%S and the like become its start")
    topics: tuple[str, ...] = Field(
        default=(), description="empty: all that the table of topics says are logged"
    )
    include: tuple[str, ...] = Field(
        default=(), description="topics to record besides those, for example stereo"
    )
    compress: bool | None = Field(
        default=None,
        description="null: unless pictures come, which take longer to compress than to write",
    )
    start_paused: bool = Field(
        default=False,
        description="record only while a `recording` message says so, to a bag for each time",
    )
    keep_free_bytes: int = Field(
        default=256 << 20,
        ge=0,
        description="with less than this left on the disk the bag is ended, with its index; with "
        "twice as much again, recording goes on in another",
    )
    watch_hz: float = Field(default=2.0, gt=0.0, description="how often the disk is looked at")
    attach: tuple[Path, ...] = Field(
        default=RUN_FILES, description="files that go into the bag; @run is the run's directory"
    )
