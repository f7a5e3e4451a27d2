"""A rendered room as a recorded sequence, and a codec small enough for tests."""

import hashlib

import cv2
import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.codec import DecodedImage, EncodedImage
from semcast.common.geometry import exp_so3, make_transform
from semcast.common.phy.slots import BLOCK_PX, DATA_PER_BLOCK, layout_for
from semcast.common.trajectory import Trajectory, write_tum

CAMERA = Intrinsics(fx=180, fy=180, cx=111.5, cy=79.5, width=224, height=160)
#: Plane normals n and offsets d of the room: n @ p = d.
WALLS = (((0, 0, 1), 7.0), ((0, 1, 0), 1.6), ((0, -1, 0), 1.8), ((1, 0, 0), 3.0), ((-1, 0, 0), 2.5))


def room_texture(rng):
    fine = cv2.GaussianBlur(rng.integers(0, 256, (512, 512)).astype(np.float32), None, 3.0)
    coarse = cv2.resize(rng.integers(0, 256, (32, 32)).astype(np.float32), (512, 512))
    grey = (fine - fine.mean()) / fine.std() * 30 + (coarse - coarse.mean()) / coarse.std() * 25 + 128
    return np.clip(grey[..., None] * np.array([1.0, 0.9, 0.8]), 0, 255).astype(np.uint8)


def render_room(T_world_cam, texture):
    """Cast a ray per pixel to the nearest wall and look its texture up."""
    xs, ys = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = CAMERA.unproject(np.stack([xs.ravel(), ys.ravel()], axis=1)) @ T_world_cam[:3, :3].T
    centre = T_world_cam[:3, 3]
    nearest, uv = np.full(len(rays), np.inf), np.zeros((len(rays), 2))
    for normal, offset in WALLS:
        n = np.array(normal, dtype=float)
        with np.errstate(divide="ignore"):
            depth = (offset - n @ centre) / (rays @ n)
        hit = (depth > 0) & (depth < nearest)
        nearest[hit] = depth[hit]
        points = centre + depth[hit, None] * rays[hit]
        uv[hit] = np.delete(points, int(np.abs(n).argmax()), axis=1) * 40 + 20 * np.abs(n).argmax() + offset
    maps = (uv % 511).astype(np.float32).reshape(CAMERA.height, CAMERA.width, 2)
    return cv2.remap(texture, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR)


def room_poses(num_frames):
    """Camera to world: forward and sideways with a slow turn."""
    k = np.arange(num_frames)
    return np.stack(
        [
            make_transform(exp_so3([0.0, 0.004 * i, 0.002 * i]), [0.06 * i, 0.01 * np.sin(i / 3), 0.05 * i])
            for i in k
        ]
    )


def write_room_sequence(folder, num_frames):
    texture = room_texture(np.random.default_rng(7))
    T_world_cam = room_poses(num_frames)
    t_s = 100.0 + 0.1 * np.arange(num_frames)
    (folder / "images").mkdir(parents=True)
    for i, T in enumerate(T_world_cam):
        image = render_room(T, texture)
        cv2.imwrite(str(folder / "images" / f"{i:06d}.png"), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    (folder / "times.txt").write_text("".join(f"{t:.6f}\n" for t in t_s))
    CAMERA.save(folder / "intrinsics.json")
    write_tum(folder / "groundtruth.txt", Trajectory(t_s, T_world_cam))
    return folder


@pytest.fixture(scope="session")
def room(tmp_path_factory):
    """A sequence of 24 frames of 224x160 with exact poses."""
    return write_room_sequence(tmp_path_factory.mktemp("sequence") / "room", 24)


class PhaseCodec:
    """Grey values of a 7x6 grid per block as phases of unit symbols: no power scale to transmit."""

    name, modulation = "phase", "16qam"
    digest = hashlib.sha256(b"phase").hexdigest()[:16]
    rows, columns = 7, 6

    def __init__(self):
        self.num_encoded = self.num_decoded = 0

    def encode(self, image, snr_db):
        self.num_encoded += 1
        layout = layout_for(image.shape[:2])
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        grid_wh = (layout.blocks_per_slot * self.columns, layout.num_slots * self.rows)
        grid = cv2.resize(grey, grid_wh, interpolation=cv2.INTER_AREA)
        blocks = grid.reshape(layout.num_slots, self.rows, layout.blocks_per_slot, self.columns)
        values = blocks.transpose(0, 2, 1, 3).reshape(layout.num_slots, layout.blocks_per_slot, -1)
        phases = np.zeros((layout.num_slots, layout.blocks_per_slot, DATA_PER_BLOCK))
        phases[..., : values.shape[-1]] = (values / 255.0 - 0.5) * np.pi
        symbols = np.exp(1j * phases).astype(np.complex64).reshape(layout.num_slots, -1)
        return EncodedImage(image.shape[:2], symbols, "analog")

    def decode(self, received):
        self.num_decoded += 1
        layout = layout_for(received.shape_hw)
        height, width = received.shape_hw
        phases = np.angle(received.symbols.reshape(layout.num_slots, layout.blocks_per_slot, -1))
        grey = np.clip(phases[..., : self.rows * self.columns] / np.pi + 0.5, 0.0, 1.0) * 255.0
        blocks = grey.reshape(layout.num_slots, layout.blocks_per_slot, self.rows, self.columns)
        grid = blocks.transpose(0, 2, 1, 3).reshape(layout.num_slots * self.rows, -1).astype(np.float32)
        image = cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
        snr = 10.0 ** (received.effective_snr_db / 10.0)
        confidence = np.repeat(snr / (1.0 + snr), BLOCK_PX)[:height, None] * np.ones((1, width))
        rgb = np.repeat(np.clip(image, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
        return DecodedImage(rgb, confidence.astype(np.float32))


@pytest.fixture
def phase_codec():
    return PhaseCodec()
