"""The pictures of a session: a few, spread over it, and those at marked moments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

MARKED_MOST = 40
"""Shots of marked moments that are kept; the others are counted."""

WIDEST_PX = 420
QUALITY = 82


@dataclass(frozen=True, slots=True)
class Shot:
    """Some JPEG pictures of one moment, each with what it shows; marked: of a marked moment."""

    seconds: float
    title: str
    pictures: tuple[tuple[str, bytes], ...]
    marked: str = ""


@dataclass(slots=True)
class Album:
    """At most `limit` shots, evenly out of all that came, and the first after each moment.

    moments: (seconds, label), in order.  seen: how many came.  left_out: shots of moments
    beyond the first `MARKED_MOST`.
    """

    limit: int
    bookmarks: Sequence[tuple[float, str]] = ()
    seen: int = 0
    left_out: int = 0
    _every: int = 1
    _held: list[Shot] = field(default_factory=list)
    _marked: list[Shot] = field(default_factory=list)

    def take(
        self, seconds: float, title: str, pictures: Sequence[tuple[str, NDArray[np.uint8]]]
    ) -> None:
        """Look at a shot; it is made small only if it is kept."""
        passed = [label for at_s, label in self.bookmarks if at_s <= seconds]
        self.bookmarks = self.bookmarks[len(passed) :]
        if passed and len(self._marked) >= MARKED_MOST:
            self.left_out += 1
        elif passed:
            self._marked.append(_shot(seconds, title, pictures, "; ".join(passed)))
        elif self.seen % self._every == 0:
            self._held.append(_shot(seconds, title, pictures))
            if len(self._held) > self.limit:
                del self._held[1::2]
                self._every *= 2
        self.seen += 1

    def shots(self) -> list[Shot]:
        """All that are kept, in the order of time."""
        return sorted((*self._held, *self._marked), key=lambda shot: shot.seconds)


def _shot(
    seconds: float,
    title: str,
    pictures: Sequence[tuple[str, NDArray[np.uint8]]],
    marked: str = "",
) -> Shot:
    return Shot(seconds, title, tuple((name, jpeg(one)) for name, one in pictures), marked)


def jpeg(image: NDArray[np.uint8]) -> bytes:
    """A picture (h, w) grey or (h, w, 3) red, green, blue, at most `WIDEST_PX` wide, as JPEG."""
    height, width = image.shape[:2]
    if width > WIDEST_PX:
        size = (WIDEST_PX, max(round(height * WIDEST_PX / width), 1))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    if image.ndim == 3:
        image = image[:, :, ::-1]
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(image), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return data.tobytes()
