"""Select images of a recorded session for the report.

Images are selected at regular intervals and at bookmarks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from flexsheet.nodes.arrays import Image

MAX_BOOKMARK_SHOTS = 40
"""The maximum number of stored image sets at bookmarks. Further image sets are only counted."""

MAX_WIDTH_PX = 420
QUALITY = 82


@dataclass(frozen=True, slots=True)
class Shot:
    """A set of JPEG images that were taken at one time.

    seconds: time since the start of the bag.
    pictures: (title, JPEG data) of each image.
    marked: label of a bookmark at this time; empty if there is none.
    """

    seconds: float
    title: str
    pictures: tuple[tuple[str, bytes], ...]
    marked: str = ""


@dataclass(slots=True)
class Album:
    """A selection of image sets: sets at regular intervals, and the first set after each bookmark.

    limit: maximum number of image sets at regular intervals.
    bookmarks: time (s) and label of each bookmark, in chronological order.
    count: number of all image sets in the session.
    left_out: number of image sets after bookmarks that are not stored, because too many such sets
        are already stored.
    """

    limit: int
    bookmarks: Sequence[tuple[float, str]] = ()
    count: int = 0
    left_out: int = 0
    _every: int = 1
    _regular: list[Shot] = field(default_factory=list)
    _at_bookmarks: list[Shot] = field(default_factory=list)

    def add(self, seconds: float, title: str, pictures: Sequence[tuple[str, Image]]) -> None:
        """Add a set of images. The images are encoded and stored only if the set is selected.

        seconds: time since the start of the bag.
        pictures: (title, image) of each image.
        """
        passed = [label for at_s, label in self.bookmarks if at_s <= seconds]
        self.bookmarks = self.bookmarks[len(passed) :]
        if passed and len(self._at_bookmarks) >= MAX_BOOKMARK_SHOTS:
            self.left_out += 1
        elif passed:
            self._at_bookmarks.append(_shot(seconds, title, pictures, "; ".join(passed)))
        elif self.count % self._every == 0:
            self._regular.append(_shot(seconds, title, pictures))
            if len(self._regular) > self.limit:
                del self._regular[1::2]
                self._every *= 2
        self.count += 1

    def shots(self) -> list[Shot]:
        """Return the selected image sets in chronological order."""
        return sorted((*self._regular, *self._at_bookmarks), key=lambda shot: shot.seconds)


def _shot(
    seconds: float, title: str, pictures: Sequence[tuple[str, Image]], marked: str = ""
) -> Shot:
    return Shot(seconds, title, tuple((name, jpeg(one)) for name, one in pictures), marked)


def jpeg(image: Image) -> bytes:
    """Encode a grey image (height, width) or an RGB image (height, width, 3) as JPEG.

    An image that is wider than `MAX_WIDTH_PX` is reduced to this width.
    """
    height, width = image.shape[:2]
    if width > MAX_WIDTH_PX:
        size = (MAX_WIDTH_PX, max(round(height * MAX_WIDTH_PX / width), 1))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    if image.ndim == 3:
        image = image[:, :, ::-1]
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(image), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return data.tobytes()
