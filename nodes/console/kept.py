"""What a console that is started again takes up from the one before it in the same run."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from flexsheet.messages.files import write_file
from flexsheet.messages.scene import Scene
from flexsheet.nodes.console.finger import FingerIntent
from flexsheet.nodes.console.scenes import SceneChoiceError


class Kept(BaseModel):
    """base: the scene that was chosen; sliders: what they made of it, None: they rest.

    recording: whether the recorder had been told to record.  finger: what was wanted of the finger,
    None: nobody had moved it.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    base: Scene
    sliders: tuple[float, float, float] | None = None
    recording: bool = False
    finger: FingerIntent | None = None


def load_kept(path: Path) -> Kept | None:
    """What was kept; None where nothing was.  SceneChoiceError for a file of something else."""
    try:
        return Kept.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValidationError) as error:
        first = str(error).splitlines()[0]
        raise SceneChoiceError(
            f"{path}: cannot be taken up again, so the first scene holds: {first}"
        ) from error


def save_kept(path: Path, kept: Kept) -> None:
    """Write it whole or not at all."""
    write_file(path, kept.model_dump_json())
