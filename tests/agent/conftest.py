import cv2
import numpy as np
import pytest
from stream_bench import Bench

from semcast.common.camera import Intrinsics
from semcast.common.codec import DecodedImage, EncodedImage
from semcast.common.phy.slots import BLOCK_PX, DATA_PER_BLOCK, layout_for

NUM_FRAMES = 12
SIZE_WH = (64, 48)


class TinyCodec:
    """Sends the mean brightness of each block as analog symbols, repeated; decodes to flat blocks."""

    name = "tiny"
    digest, modulation = "0123", "analog"

    def __init__(self):
        self.snrs_db = []

    def encode(self, image, snr_db):
        self.snrs_db.append(snr_db)
        layout = layout_for(image.shape[:2])
        means = cv2.resize(image, (layout.blocks_per_slot, layout.num_slots), interpolation=cv2.INTER_AREA)
        level = means.mean(axis=2) / 127.5 - 1.0
        symbols = np.repeat(
            (np.sqrt(1.0 - level**2) + 1j * level).astype(np.complex64), DATA_PER_BLOCK, axis=1
        )
        return EncodedImage(image.shape[:2], symbols, "analog")

    def decode(self, received):
        height, width = received.shape_hw
        blocks = received.symbols.reshape(received.symbols.shape[0], -1, DATA_PER_BLOCK).mean(axis=2)
        level = blocks.imag / np.maximum(np.abs(blocks), 1e-6)
        grey = np.clip((level + 1.0) * 127.5, 0, 255).astype(np.uint8)
        full = np.repeat(np.repeat(grey, BLOCK_PX, 0), BLOCK_PX, 1)[:height, :width]
        return DecodedImage(np.repeat(full[:, :, None], 3, 2), np.ones((height, width), np.float32))


@pytest.fixture
def codec():
    return TinyCodec()


@pytest.fixture
def bench(recording, codec):
    opened = Bench(recording, codec)
    yield opened
    opened.close()


@pytest.fixture(scope="session")
def recording(tmp_path_factory):
    """Twelve frames, 20 ms apart; frame k has brightness 20 k."""
    folder = tmp_path_factory.mktemp("recordings") / "steps"
    (folder / "images").mkdir(parents=True)
    for k in range(NUM_FRAMES):
        image = np.full((SIZE_WH[1], SIZE_WH[0], 3), 20 * k, np.uint8)
        cv2.imwrite(str(folder / "images" / f"{k:06d}.png"), image)
    (folder / "times.txt").write_text("".join(f"{5 + 0.02 * k:.9f}\n" for k in range(NUM_FRAMES)))
    Intrinsics(fx=50.0, fy=50.0, cx=31.5, cy=23.5, width=64, height=48).save(folder / "intrinsics.json")
    return folder


@pytest.fixture(scope="session")
def video(tmp_path_factory):
    """The same as a lossless video of 9 frames at 50 Hz, or a skip where OpenCV can't write one."""
    path = tmp_path_factory.mktemp("videos") / "steps.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"FFV1"), 50.0, SIZE_WH)
    if not writer.isOpened():
        pytest.skip("this OpenCV can't write FFV1")
    for k in range(9):
        writer.write(np.full((SIZE_WH[1], SIZE_WH[0], 3), 20 * k, np.uint8))
    writer.release()
    return path
