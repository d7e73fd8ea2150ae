"""Read a force gauge that sends lines of text over a serial port."""

from __future__ import annotations

import contextlib
import math
import os
import re
import termios

from flexsheet.messages.errors import FlexsheetError

MAX_LINE_BYTES = 256
NUMBER = re.compile(rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


class GaugeError(FlexsheetError, OSError):
    """Raised if a gauge cannot be opened or read. The text names the device and the cause."""

    code = "gauge"
    remedy = "Check the cable, the path in `port`, and the permission to open it (group dialout)."

    def __str__(self) -> str:
        return str(self.strerror)


class SerialGauge:
    """A gauge at a serial port that sends one measurement per line, such as "+0.123 N".

    unreadable: number of received lines that contain no finite number.
    """

    def __init__(self, port: str, baud: int) -> None:
        """Open the serial port. Raises GaugeError if this fails."""
        self.port, self.unreadable, self._rest = port, 0, b""
        speed = getattr(termios, f"B{baud}", None)
        if speed is None:
            raise GaugeError(
                0, f"{port}: the baud rate {baud} is not supported; use for example 9600"
            )
        self._fd = -1
        try:
            self._fd = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            settings = termios.tcgetattr(self._fd)
            settings[0:4] = [0, 0, termios.CS8 | termios.CREAD | termios.CLOCAL, 0]
            settings[4:6] = [speed, speed]
            termios.tcsetattr(self._fd, termios.TCSANOW, settings)
        except (OSError, termios.error) as error:
            self.close()
            reason = error.strerror if isinstance(error, OSError) else error.args[-1]
            raise GaugeError(
                0,
                f"{port}: cannot be opened as a serial port: {reason}; check the path and the "
                "permissions",
            ) from error

    def fileno(self) -> int:
        """Return the file descriptor on which the caller can wait for data."""
        return self._fd

    def read(self) -> list[float]:
        """Return the numbers that have arrived. Raises GaugeError if the connection is lost."""
        try:
            data = os.read(self._fd, 4096)
        except BlockingIOError:
            return []
        except OSError as error:
            raise GaugeError(
                0, f"{self.port}: cannot be read: {error.strerror}; check the cable of the gauge"
            ) from error
        if not data:
            raise GaugeError(
                0,
                f"{self.port}: the device has closed the connection; check the cable of the gauge",
            )
        *lines, rest = re.split(rb"[\r\n]+", self._rest + data)
        self._rest = rest[-MAX_LINE_BYTES:]
        found = [parse_line(line) for line in lines if line.strip()]
        self.unreadable += found.count(None)
        return [value for value in found if value is not None]

    def close(self) -> None:
        if self._fd >= 0:
            with contextlib.suppress(OSError):
                os.close(self._fd)
        self._fd = -1


def parse_line(line: bytes) -> float | None:
    """Return the first number in a line, or None if the line contains no finite number."""
    found = NUMBER.search(line[:MAX_LINE_BYTES])
    value = math.nan if found is None else float(found.group())
    return value if math.isfinite(value) else None
