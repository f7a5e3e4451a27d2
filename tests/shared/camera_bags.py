"""Bags with the images of one camera, and how they are unpacked."""

import numpy as np
from bags import SECOND

from semcast.agent.unpack import UnpackSettings

#: A time at which seconds as a float have no single nanoseconds any more.
START = 1_700_000_000 * SECOND + 1
STEP = SECOND // 10
K = (50.0, 0.0, 31.5, 0.0, 51.0, 23.5, 0.0, 0.0, 1.0)
P = (40.0, 0.0, 30.5, 0.0, 0.0, 41.0, 22.5, 0.0, 0.0, 0.0, 1.0, 0.0)
D = (0.1, -0.2, 0.001, 0.002, 0.003)
WH = (64, 48)


def picture(k):
    return np.full((WH[1], WH[0], 3), 10 * k, np.uint8)


def add_images(bag, topic="/cam/image_raw", count=5, frame="cam"):
    for k in range(count):
        bag.image(topic, picture(k), "bgr8", START + k * STEP, frame)


def settings(bag, tmp_path, **options):
    return UnpackSettings(bag=bag.write(tmp_path), out=tmp_path / "out", **options)
