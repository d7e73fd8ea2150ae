"""Read and write calibration files in YAML, with every number in full precision."""

from __future__ import annotations

import io
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, Self

from pydantic import ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.files import write_file
from flexsheet.messages.scene import Part


class CalibrationFileError(FlexsheetError, ValueError):
    """Raised if a calibration file is invalid. The text names the file, the key and the remedy."""

    exit_code = 2


class CalibrationMismatchError(FlexsheetError, ValueError):
    """Raised if a calibration was made for a camera, sheet or device that is not in the scene."""

    exit_code = 2


class CalibrationFile(Part):
    """The base class of calibrations, which are stored in YAML files.

    command: command that writes such files. Comments and error texts name this command.
    """

    command: ClassVar[str]

    def save(self, path: Path, *, comment: str = "") -> None:
        """Write the calibration to a YAML file.

        An existing file is replaced only after the new file has been written completely.

        comment: second comment line, such as the command line that wrote the file; empty if there
            is no second comment line.

        Raises FileWriteError if the file cannot be written.
        """
        yaml = YAML()
        yaml.default_flow_style = None
        yaml.width = 4096  # one line per row of a matrix
        text = io.StringIO()
        values = self.model_dump(mode="json")
        text.write(f"# Result of `{self.command}`, {values['date']}.\n")
        if comment:
            text.write(f"# {comment}\n")
        yaml.dump(values, text)
        write_file(path, text.getvalue())

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a calibration from a YAML file.

        Raises CalibrationFileError if the file is missing, incomplete, or of another type or
        version.
        """
        try:
            content = _parse_text(path.read_bytes().decode())
        except OSError as error:
            raise CalibrationFileError(
                f"{path}: cannot be read: {error.strerror}; check the path, which is relative to "
                f"the file that names it, or write the calibration with `{cls.command}`"
            ) from error
        # The parser raises undocumented errors for invalid numbers and dates.
        except (YAMLError, ValueError, RecursionError, TypeError) as error:
            raise CalibrationFileError(
                f"{path}: this is not a valid calibration file: {str(error)[:200]}; "
                f"run `{cls.command}`"
            ) from error
        if not isinstance(content, dict) or "version" not in content:
            raise CalibrationFileError(
                f"{path}: this is not a calibration, because it has no key `version`; "
                f"run `{cls.command}`"
            )
        version = cls.model_fields["version"].default
        if content["version"] != version:
            raise CalibrationFileError(
                f"{path}: the key `version` is {content['version']!r}, expected {version}; "
                f"calibrate again with `{cls.command}`"
            )
        try:
            return cls.model_validate(content)
        except ValidationError as error:
            problems = "; ".join(
                f"{'.'.join(str(part) for part in problem['loc'])}: {problem['msg']}"
                for problem in error.errors()[:5]
            )
            raise CalibrationFileError(
                f"{path}: this is not a calibration file that `{cls.command}` wrote: {problems}"
            ) from error


@lru_cache(maxsize=8)
def _parse_text(text: str) -> Any:
    """Parse YAML text. The caller must not change the result, which is cached."""
    return YAML(typ="safe", pure=True).load(text)
