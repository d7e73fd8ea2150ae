"""Save and load the state with which a restarted console continues."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from flexsheet.messages.files import write_file
from flexsheet.messages.scene import Scene
from flexsheet.nodes.console.finger import FingerIntent
from flexsheet.nodes.console.scenes import MIN_STRETCH_RATIO, SceneChoiceError


@dataclass(frozen=True, slots=True)
class Sliders:
    """The positions of the sliders on the console page.

    young_modulus_pa: Young's modulus of the object; None if the object is rigid.
    stretch_ratio: minimum stretch ratio of the sheet.
    size_ratio: size of the object, relative to its size in the scene file.
    """

    young_modulus_pa: float | None
    stretch_ratio: float
    size_ratio: float

    @staticmethod
    def from_scene(scene: Scene) -> Sliders:
        """Return the slider positions that correspond to an unchanged scene."""
        material = scene.object.material
        return Sliders(
            None if material is None else material.young_modulus_pa,
            max(scene.sheet.min_stretch_ratio, MIN_STRETCH_RATIO),
            1.0,
        )


class ConsoleState(BaseModel):
    """The saved state of a console.

    base: selected scene.
    sliders: slider positions; None if no slider was moved.
    recording: whether a viewer has requested a recording.
    finger: requested finger position; None if no viewer has moved the finger.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    base: Scene
    sliders: Sliders | None = None
    recording: bool = False
    finger: FingerIntent | None = None


def load_state(path: Path) -> ConsoleState | None:
    """Read the saved state of a console; return None if the file does not exist.

    Raises SceneChoiceError if the file is invalid.
    """
    try:
        return ConsoleState.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValidationError) as error:
        first = str(error).splitlines()[0]
        raise SceneChoiceError(
            f"{path}: the saved state is invalid, so the console starts with the first scene; "
            f"choose the scene again ({first})"
        ) from error


def save_state(path: Path, state: ConsoleState) -> None:
    """Write the state of the console to a file in one atomic operation."""
    write_file(path, state.model_dump_json())
