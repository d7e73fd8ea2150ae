"""How calibrations are kept: as YAML that people can read, with every number in full precision."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent

from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.files import write_file
from flexsheet.messages.scene import Part

Calibration = TypeVar("Calibration", bound=Part)


MAX_CALIBRATION_BYTES = 1 << 20
MAX_CALIBRATION_DEPTH = 12


class CalibrationFileError(FlexsheetError, ValueError):
    """A calibration file that cannot be used; the message names file, key and remedy."""

    code = "calibration-file"
    remedy = "Calibrate again, or name another calibration file."


class CalibrationMismatchError(FlexsheetError, ValueError):
    """A calibration of something else than the scene's: another camera, another sheet."""

    code = "calibration-mismatch"
    remedy = "Name the calibration of the scene's own device, or the scene of the calibration."


def write_calibration(calibration: Part, path: Path, *, title: str, comment: str) -> None:
    """Write the file, replacing an older one only when the new one is complete.

    title: the first line of its head.  comment: one line more, as the command that made it.
    """
    yaml = YAML()
    yaml.default_flow_style = None
    yaml.width = 4096  # a row of a matrix a line
    text = io.StringIO()
    text.write(f"# {title}\n")
    if comment:
        text.write(f"# {comment}\n")
    yaml.dump(calibration.model_dump(mode="json"), text)
    write_file(path, text.getvalue())


def _parse(path: Path) -> Any:
    """The values of a file; YAMLError for one that no command of ours has written."""
    with path.open("rb") as file:
        data = file.read(MAX_CALIBRATION_BYTES + 1)
    if len(data) > MAX_CALIBRATION_BYTES:
        raise YAMLError(f"more than {MAX_CALIBRATION_BYTES} bytes")
    text = data.decode()
    depth = 0
    for event in YAML(typ="safe").parse(text):
        # A few aliases can stand for any number of values.
        if isinstance(event, AliasEvent):
            raise YAMLError("an alias (*), which no calibration has")
        depth += isinstance(event, CollectionStartEvent)
        depth -= isinstance(event, CollectionEndEvent)
        if depth > MAX_CALIBRATION_DEPTH:
            raise YAMLError(f"more than {MAX_CALIBRATION_DEPTH} lists or mappings are nested")
    return YAML(typ="safe").load(text)


def read_calibration(
    kind: type[Calibration], path: Path, *, version: int, command: str
) -> Calibration:
    """Read a calibration of one kind, as its command wrote it.

    Raises CalibrationFileError for a file that is absent, foreign, of another version or
    incomplete.
    """
    try:
        content = _parse(path)
    except OSError as error:
        raise CalibrationFileError(
            f"{path}: cannot be read: {error.strerror}; name a file that `{command}` wrote"
        ) from error
    # Numbers and dates that are none make the parser raise what it likes.
    except (YAMLError, ValueError, RecursionError, TypeError) as error:
        raise CalibrationFileError(
            f"{path}: not YAML that `{command}` wrote: {str(error)[:200]}"
        ) from error
    if not isinstance(content, dict) or "version" not in content:
        raise CalibrationFileError(
            f'{path}: no key "version": not a calibration; `{command}` writes one'
        )
    if content["version"] != version:
        raise CalibrationFileError(
            f"{path}: version: {content['version']!r}, this program reads {version}; "
            f"calibrate again with `{command}`"
        )
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        problems = "; ".join(
            f"{'.'.join(str(part) for part in problem['loc'])}: {problem['msg']}"
            for problem in error.errors()[:5]
        )
        raise CalibrationFileError(f"{path}: not what `{command}` writes: {problems}") from error
