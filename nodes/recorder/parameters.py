"""Define the parameters of the recorder."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from flexsheet.nodes.node import NodeParameters

RUN_FILES = tuple(
    Path("@run") / name for name in ("launch.yaml", "scene.yaml", "plan.json", "git.json")
)


class RecorderParameters(NodeParameters):
    """The parameters of the recorder: the topics to record, the bag file, and disk limits."""

    bag: Path = Field(
        description="bag file to write; codes such as %Y%m%d-%H%M%S are replaced by the start time"
    )
    topics: tuple[str, ...] = Field(
        default=(), description="topics to record; empty: all topics that are logged by default"
    )
    include: tuple[str, ...] = Field(
        default=(), description="further topics to record, for example stereo"
    )
    compress: bool | None = Field(
        default=None,
        description="whether the bag is compressed; null: the bag is compressed only if it has no "
        "images, because their compression takes long",
    )
    start_paused: bool = Field(
        default=False,
        description="record only while the topic `recording` requests it, each time to a new bag",
    )
    keep_free_bytes: int = Field(
        default=256 << 20,
        ge=0,
        description="free space on the disk below which the bag is ended; another bag starts when "
        "twice as much is free",
    )
    watch_hz: float = Field(
        default=2.0,
        gt=0.0,
        description="rate at which disk space, bag size and duration are checked, Hz",
    )
    max_bag_bytes: int | None = Field(
        default=None, ge=1, description="size at which another bag is started; null: no limit"
    )
    max_bag_duration_s: float | None = Field(
        default=None, gt=0.0, description="duration at which another bag is started; null: no limit"
    )
    attach: tuple[Path, ...] = Field(
        default=RUN_FILES,
        description="files to store in the bag; @run stands for the directory of the run",
    )
