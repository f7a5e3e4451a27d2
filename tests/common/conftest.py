"""Recordings of a few plain images, written for each test, and a hub."""

import cv2
import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.geometry import exp_so3, make_transform
from semcast.common.loopback import open_hub
from semcast.common.trajectory import Trajectory, write_tum

CAMERA = Intrinsics(fx=30.0, fy=31.0, cx=15.5, cy=11.5, width=32, height=24)


@pytest.fixture
def hub():
    """A session others connect to, and its endpoint."""
    session, endpoint = open_hub()
    with session:
        yield session, endpoint


@pytest.fixture
def write_images():
    """Return a function that writes images whose red and green are ten times their number."""

    def write(folder, count, pattern="{:06d}.png", size=(24, 32), channels=3):
        folder.mkdir(parents=True, exist_ok=True)
        for k in range(count):
            image = np.full((*size, 3) if channels == 3 else size, k * 10, dtype=np.uint8)
            if channels == 3:
                image[:, :, 0] = 200  # blue in OpenCV's order
            cv2.imwrite(str(folder / pattern.format(k)), image)

    return write


@pytest.fixture
def poses():
    """Return a function that gives ``(count, 4, 4)`` poses along a bend."""

    def along(count, step=0.5):
        return np.array(
            [make_transform(exp_so3([0.0, 0.1 * k, 0.0]), (step * k, 0.0, 0.2 * k)) for k in range(count)]
        )

    return along


@pytest.fixture
def native(tmp_path, write_images, poses):
    folder = tmp_path / "walk"
    write_images(folder / "images", 5)
    (folder / "times.txt").write_text("".join(f"{0.1 * k:.9f}\n" for k in range(5)))
    CAMERA.save(folder / "intrinsics.json")
    write_tum(folder / "groundtruth.txt", Trajectory(0.1 * np.arange(5), poses(5)))
    return folder
