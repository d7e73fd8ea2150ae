"""Which pairs of pictures may be measured in."""

from __future__ import annotations

from messages.types import StereoPair
from nodes.triangulator.triangulation import StereoGeometry


class ForeignPicturesError(ValueError):
    """Pictures of another device, or parts of a sensor that the scene's camera does not have."""


def refuse_other_pictures(pair: StereoPair, geometry: StereoGeometry) -> None:
    """Raise ForeignPicturesError unless the pictures are of that rig, whole or in part."""
    if pair.device != geometry.device:
        raise ForeignPicturesError(
            f'pictures of device "{pair.device}", the scene\'s is "{geometry.device}"'
        )
    views = (("left", pair.left, pair.left_origin_px), ("right", pair.right, pair.right_origin_px))
    for side, image, (column, row) in views:
        height, width = image.shape
        inside = column >= 0 and row >= 0
        if not inside or column + width > geometry.width_px or row + height > geometry.height_px:
            raise ForeignPicturesError(
                f"{side} picture of {width}x{height} px from column {column}, row {row}; the "
                f"scene's camera {pair.device} has {geometry.width_px}x{geometry.height_px} px"
            )
