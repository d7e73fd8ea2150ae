"""Make the paths of the simulated finger that commands accept: gestures by name, and CSV files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from flexsheet.launch.calibration.csv_rows import parse_finite, read_table
from flexsheet.launch.experiments import ExperimentError, stroke
from flexsheet.launch.plans.documents import BadInputError, Problem, did_you_mean
from flexsheet.launch.plans.plan import load_graph
from flexsheet.messages.scene import Scene, UnfitGeometryError
from flexsheet.messages.types import FingerPath
from flexsheet.nodes.twin import gestures
from flexsheet.nodes.twin.finger import FingerPathError
from flexsheet.nodes.twin.paths import place_recording

GESTURES: dict[str, Callable[[Scene], FingerPath]] = {
    "stroke-10": partial(stroke.stroke_path, seconds=10.0),
    "stroke-30": partial(stroke.stroke_path, seconds=30.0),
    **gestures.GESTURES,
}
"""The functions that make the finger paths of gestures, with the names of the gestures as keys.

The gestures are the finger strokes of Furukawa et al. 2007, and models of human motions.
"""

RECORDING_COLUMNS = ("t_s", "x_mm", "y_mm", "z_mm")


def gesture_path(name: str, scene: Scene) -> FingerPath:
    """Return the finger path of a gesture on the scene's object; its label is the gesture's name.

    Raises ExperimentError if the gesture does not fit the object.
    """
    try:
        return GESTURES[name](scene).model_copy(update={"label": name})
    except (FingerPathError, UnfitGeometryError) as error:
        raise ExperimentError(f'scene "{scene.name}": {error}') from None


def finger_path(launch_file: Path, name_or_file: str, settings: Sequence[str] = ()) -> FingerPath:
    """Return a finger path in the scene of a launch file.

    name_or_file: name of a gesture, or CSV file with a recorded path.
    settings: launch settings "node.parameter=value". "scene=FILE" replaces the scene.

    Raises BadInputError if the name is unknown or the recorded path is invalid, and ExperimentError
    if the launch file has no scene.
    """
    scene = load_graph(launch_file, settings=settings).scene_message()
    if scene is None:
        raise ExperimentError(
            f'{launch_file}: missing key "scene", which a finger path requires; add the key'
        )
    if name_or_file in GESTURES:
        return gesture_path(name_or_file, scene)
    file = Path(name_or_file)
    if not file.suffix and not file.exists():
        raise BadInputError.single(
            name_or_file,
            (),
            "neither a gesture nor a file",
            f"{did_you_mean(name_or_file, list(GESTURES))} A recorded finger is a CSV file",
        )
    return recorded_path(file, scene)


def recorded_path(file: Path, scene: Scene) -> FingerPath:
    """Read a recorded fingertip path from a CSV file, and map the path to the scene's object.

    The file has the columns t_s, x_mm, y_mm and z_mm. Raises BadInputError if it is invalid.
    """
    table = read_table(file, RECORDING_COLUMNS)
    rows: list[list[float]] = []
    for number, cells in table.rows:
        where = f"{file}:{number}"
        row = [parse_finite(where, name, cells[name], table.problems) for name in RECORDING_COLUMNS]
        if rows and row[0] <= rows[-1][0]:
            remedy = "sort the lines by t_s, or delete this line"
            table.problems.append(Problem(where, ("t_s",), "does not increase", remedy))
        rows.append(row)
    table.check()
    if len(rows) < 2:
        remedy = "give a path with at least two samples"
        raise BadInputError.single(str(file), (), f"{len(rows)} samples found", remedy)
    recorded = np.array(rows)
    times_s = recorded[:, 0] - recorded[0, 0]
    return place_recording(file.stem, times_s, recorded[:, 1:] * 1e-3, scene)
