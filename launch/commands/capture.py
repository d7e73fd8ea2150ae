"""Capture board images for `flexsheet calibrate stereo`, from devices or the simulator."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flexsheet.launch.commands.output import FAILED, CommandError, words
from flexsheet.messages.files import write_file
from flexsheet.nodes.camera.image_pair import encode_png

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from flexsheet.launch.calibration.capture import Capture
    from flexsheet.messages.apparatus import Apparatus
    from flexsheet.messages.calibration import Board
    from flexsheet.messages.scene import Scene

    Views = tuple[NDArray[np.uint8], NDArray[np.uint8]]

POSES_PER_PAIR = 3
"""The number of simulated board poses per requested image pair; some poses are rejected."""


def read_device_views(source: str, scene: Scene) -> Iterator[Views]:
    """Yield grey image pairs of a real camera.

    source: YAML text, as in the parameter `source` of a camera node.

    Raises CommandError if the source is invalid, and DeviceError if the device fails.
    """
    from pydantic import TypeAdapter, ValidationError
    from ruamel.yaml.error import YAMLError

    from flexsheet.launch.plans.documents import parse_value
    from flexsheet.nodes.camera.devices import open_reader
    from flexsheet.nodes.camera.image_pair import check_size
    from flexsheet.nodes.camera.sources import AnySource

    try:
        described: Any = TypeAdapter(AnySource).validate_python(parse_value(source))
    except (YAMLError, ValidationError) as error:
        problem = str(error).splitlines()[0]
        if isinstance(error, ValidationError):
            mistakes = [(".".join(map(str, one["loc"])), one["msg"]) for one in error.errors()]
            problem = "; ".join(f"{where}: {what}" for where, what in mistakes)
        raise CommandError(
            f"--device-source {source}: {problem}; use the format of a camera node's parameter "
            "source, such as '{kind: live, left: 0, right: 1}'"
        ) from error
    if described.kind == "twin":
        raise CommandError(
            "--device-source twin: the simulator of a graph shows no board; use --twin SCENE"
        )
    with closing(open_reader(described, scene.camera, time.monotonic_ns)) as reader:
        for warning in reader.warnings:
            words.print(f"camera: {warning}")
        while (images := reader.read()) is not None:
            check_size(images, scene.camera, source)
            yield images.left, images.right


def simulate_views(
    scene: Scene, board: Board, apparatus: Apparatus | None = None, *, pairs: int, seed: int
) -> Iterator[Views]:
    """Yield simulated image pairs of a calibration board, one pair for each random pose.

    If an apparatus (true hardware parameters) is given, the images have the errors of its camera.
    """
    from flexsheet.nodes.twin.board import TwinBoard
    from flexsheet.nodes.twin.rig import make_true_camera
    from flexsheet.nodes.twin.truth import apply_apparatus

    camera = make_true_camera(apply_apparatus(scene, apparatus).camera)
    shown = TwinBoard(camera, board, seed=seed)
    for left_from_board in shown.poses(POSES_PER_PAIR * pairs):
        yield shown.pair(left_from_board)


def write_pairs(views: Iterator[Views], capture: Capture, folder: Path) -> int:
    """Write the accepted image pairs to a new folder: left01.png, right01.png, ...

    The function stops when the board poses meet all requirements, when `views` ends, or when the
    user presses Ctrl-C. It prints the requirements that are not met. Returns the number of pairs,
    at least one.
    """
    if folder.exists():
        raise CommandError(f"--pictures {folder}: the folder exists; name a new folder")
    accepted = 0
    try:
        with words.status("waiting for images") as status:
            for left, right in views:
                view = capture.add_pair(left, right)
                if view.accepted:
                    accepted += 1
                    folder.mkdir(parents=True, exist_ok=True)
                    for side, image in (("left", left), ("right", right)):
                        write_file(folder / f"{side}{accepted:02}.png", encode_png(image))
                    words.print(f"pair {view.hint}")
                status.update(f"{view.hint}; requirements to meet: {len(capture.missing())}")
                if capture.complete:
                    break
    except KeyboardInterrupt:
        words.print("capture stopped; using the pairs captured so far")
    missing = capture.missing()
    if missing:
        from flexsheet.launch.calibration.capture import describe_requirement

        listed = ", ".join(dict.fromkeys(map(describe_requirement, missing)))
        words.print(f"too few image pairs show the board: {listed}")
    if not accepted:
        raise CommandError(
            "no image pair was accepted, because the board was never at rest and fully visible in "
            "both images; hold it still in view of both cameras",
            FAILED,
        )
    words.print(f"{accepted} pairs in {folder}")
    return accepted
