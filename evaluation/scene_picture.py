"""``docs/images/scenes.jpg``: scenes drawn by formula, and what a fading link leaves of one of them.

Run as ``python -m semcast.evaluation.scene_picture`` where the source is.
"""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.channel.link import Link
from semcast.channel.settings import ChannelSettings
from semcast.common.codec import DEFAULT_CODEC
from semcast.common.codecs import load_codec
from semcast.evaluation.picture_strip import write_picture
from semcast.evaluation.scenes.render import SCENES, SceneName, frame_of
from semcast.server.view.picture import confidence_colours

Image = NDArray[np.uint8]

PICTURE = Path("docs/images/scenes.jpg")
_WIDTH_PX = 1360
_SEED = 5
_NOISE_SD = 1.5
_LINK_DB = 6.0


def side_by_side(images: Sequence[Image], width_px: int) -> Image:
    """Scale images to one height at which they fill a width; ``(H, W, 3)`` uint8 each."""
    height = round(width_px / sum(image.shape[1] / image.shape[0] for image in images))
    edges = np.cumsum([0.0, *(image.shape[1] / image.shape[0] for image in images)])
    edges = np.rint(edges * width_px / edges[-1]).astype(int)
    scaled = [
        cv2.resize(image, (int(right - left), height), interpolation=cv2.INTER_AREA)
        for image, left, right in zip(images, edges[:-1], edges[1:], strict=True)
    ]
    return np.asarray(np.hstack(scaled), dtype=np.uint8)


def scene_picture() -> Image:
    """Return a street, an orbit and a survey above; below a room as drawn, as it arrives, its confidence."""
    above = [_frame("street", 1.0), _frame("orbit", 4.0), _frame("survey", 6.0)]
    room = _frame("room", 1.0)
    codec = load_codec(DEFAULT_CODEC, num_threads=1)
    link = Link(ChannelSettings(channel="rayleigh", snr_db=_LINK_DB), _SEED)
    received = link.carry(codec.encode(room, _LINK_DB), 0.0)
    assert received is not None, "this link loses no frames"
    decoded = codec.decode(received)
    below = [room, decoded.image, confidence_colours(decoded.confidence)]
    return np.vstack([side_by_side(above, _WIDTH_PX), side_by_side(below, _WIDTH_PX)])


def _frame(scene: SceneName, t_s: float) -> Image:
    return frame_of(SCENES[scene](_SEED, "normal"), t_s, _NOISE_SD, np.random.default_rng(_SEED))


if __name__ == "__main__":
    write_picture(PICTURE, scene_picture())
