"""Read and write calibration files in YAML, with every number in full precision."""

from __future__ import annotations

import io
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer
from ruamel.yaml.error import YAMLError
from ruamel.yaml.events import AliasEvent, CollectionStartEvent
from ruamel.yaml.nodes import CollectionNode

from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.files import write_file
from flexsheet.messages.scene import Part

Calibration = TypeVar("Calibration", bound=Part)


MAX_CALIBRATION_BYTES = 1 << 20
MAX_CALIBRATION_DEPTH = 12


class CalibrationFileError(FlexsheetError, ValueError):
    """Raised if a calibration file is invalid. The text names the file, the key and the remedy."""

    exit_code = 2


class CalibrationMismatchError(FlexsheetError, ValueError):
    """Raised if a calibration was made for a camera, sheet or device that is not in the scene."""

    exit_code = 2


def write_calibration(calibration: Part, path: Path, *, title: str, comment: str) -> None:
    """Write a calibration to a YAML file.

    An existing file is replaced only after the new file has been written completely.

    title: first comment line of the file.
    comment: second comment line, such as the command that wrote the file; empty if there is no
        second comment line.

    Raises FileWriteError if the file cannot be written.
    """
    yaml = YAML()
    yaml.default_flow_style = None
    yaml.width = 4096  # one line per row of a matrix
    text = io.StringIO()
    text.write(f"# {title}\n")
    if comment:
        text.write(f"# {comment}\n")
    yaml.dump(calibration.model_dump(mode="json"), text)
    write_file(path, text.getvalue())


def _parse(path: Path) -> Any:
    """Parse a YAML file. Raises YAMLError if it is too large, or has aliases or deep nesting."""
    with path.open("rb") as file:
        data = file.read(MAX_CALIBRATION_BYTES + 1)
    if len(data) > MAX_CALIBRATION_BYTES:
        raise YAMLError(f"the file is larger than {MAX_CALIBRATION_BYTES} bytes")
    return _parse_text(data.decode())


@lru_cache(maxsize=8)
def _parse_text(text: str) -> Any:
    """Parse YAML text. The caller must not change the result, which is cached."""
    yaml = YAML(typ="safe", pure=True)
    yaml.Composer = CalibrationComposer
    return yaml.load(text)


class CalibrationComposer(Composer):
    """A YAML composer that rejects aliases and too deeply nested lists or mappings."""

    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        # A few aliases could expand to any number of values.
        if self.parser.check_event(AliasEvent):
            raise YAMLError("the file contains a YAML alias (*), which no calibration contains")
        self.depth += self.parser.check_event(CollectionStartEvent)
        if self.depth > MAX_CALIBRATION_DEPTH:
            raise YAMLError(f"more than {MAX_CALIBRATION_DEPTH} lists or mappings are nested")
        node = super().compose_node(parent, index)
        self.depth -= isinstance(node, CollectionNode)
        return node


def read_calibration(kind: type[Calibration], path: Path, *, command: str) -> Calibration:
    """Read a calibration from a YAML file.

    kind: type of the calibration, which also defines the expected version of the file.
    command: command that writes such files. Error texts name this command.

    Raises CalibrationFileError if the file is missing, incomplete, or of another type or version.
    """
    try:
        content = _parse(path)
    except OSError as error:
        raise CalibrationFileError(
            f"{path}: cannot be read: {error.strerror}; check the path, which is relative to the "
            f"file that names it, or write the calibration with `{command}`"
        ) from error
    # The parser raises undocumented errors for invalid numbers and dates.
    except (YAMLError, ValueError, RecursionError, TypeError) as error:
        raise CalibrationFileError(
            f"{path}: this is not a valid calibration file: {str(error)[:200]}; run `{command}`"
        ) from error
    if not isinstance(content, dict) or "version" not in content:
        raise CalibrationFileError(
            f"{path}: this is not a calibration, because it has no key `version`; run `{command}`"
        )
    version = kind.model_fields["version"].default
    if content["version"] != version:
        raise CalibrationFileError(
            f"{path}: the key `version` is {content['version']!r}, expected {version}; "
            f"calibrate again with `{command}`"
        )
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        problems = "; ".join(
            f"{'.'.join(str(part) for part in problem['loc'])}: {problem['msg']}"
            for problem in error.errors()[:5]
        )
        raise CalibrationFileError(
            f"{path}: this is not a calibration file that `{command}` wrote: {problems}"
        ) from error
