"""Textured rectangles land where the camera model says, and near ones hide far ones."""

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.evaluation.scenes.motion import look
from semcast.evaluation.scenes.surfaces import Surface, box, draw, exact_depth
from semcast.evaluation.scenes.textures import Texture

CAMERA = Intrinsics(fx=100.0, fy=100.0, cx=49.5, cy=39.5, width=100, height=80)
BLACK = np.zeros((80, 100, 3), np.float32)
#: Looks along the world's x from its origin: right is -y, down is -z.
AHEAD = look(np.zeros(3), 0.0, 0.0)


def plain(grey: float, side: int = 64) -> Texture:
    return Texture(np.full((side, side, 3), grey, np.uint8))


def wall(distance_m: float, half_m: float, texture: Texture) -> Surface:
    """A square wall across the view, texture upright."""
    return Surface(
        np.array([distance_m, half_m, half_m]),
        np.array([0.0, -2 * half_m, 0.0]),
        np.array([0.0, 0.0, -2 * half_m]),
        texture,
    )


def test_wall_covers_the_pixels_its_corners_project_to() -> None:
    image = draw([wall(2.0, 0.5, plain(200))], CAMERA, AHEAD, BLACK)
    rows, columns = np.nonzero(image[..., 0])
    # 100 px focal length, 0.5 m at 2 m: 25 px either side of the centre (49.5, 39.5).
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (15, 64, 25, 74)
    assert image[40, 50, 0] == pytest.approx(200, abs=0.5)


def test_texture_is_upright_and_not_mirrored() -> None:
    quarters = np.zeros((64, 64, 3), np.uint8)
    quarters[:32, :32], quarters[:32, 32:], quarters[32:, :32] = 50, 100, 150
    image = draw([wall(2.0, 0.5, Texture(quarters))], CAMERA, AHEAD, BLACK)
    seen = [round(float(image[y, x, 0])) for y, x in ((25, 35), (25, 65), (55, 35), (55, 65))]
    assert seen == [50, 100, 150, 0]


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_nearer_wall_hides_the_farther(order: tuple[int, int]) -> None:
    walls = [wall(2.0, 0.2, plain(200)), wall(4.0, 2.0, plain(80))]
    image = draw([walls[i] for i in order], CAMERA, AHEAD, BLACK)
    assert image[40, 50, 0] == pytest.approx(200, abs=0.5)
    assert image[10, 10, 0] == pytest.approx(80, abs=0.5)


def test_a_floor_that_runs_under_the_camera_is_cut_where_it_passes_it() -> None:
    floor = Surface(
        np.array([-5.0, -5.0, -1.0]), np.array([60.0, 0, 0]), np.array([0, 10.0, 0]), plain(120), (6.0, 1.0)
    )
    image = draw([floor], CAMERA, AHEAD, BLACK)
    assert np.all(image[60:, 20:80, 0] > 100)
    assert not image[:38].any()


def test_what_is_behind_the_camera_is_not_seen() -> None:
    assert not draw([wall(-2.0, 0.5, plain(200))], CAMERA, AHEAD, BLACK).any()


def test_texture_far_away_is_averaged_and_not_sampled() -> None:
    stripes = np.zeros((512, 512, 3), np.uint8)
    stripes[:, ::2] = 200
    image = draw([wall(2.0, 0.25, Texture(stripes))], CAMERA, AHEAD, BLACK)
    # 512 columns on 25 pixels: every pixel has the mean.
    assert np.abs(image[30:50, 40:60, 0] - 100).max() < 3


def test_of_two_pixels_one_may_be_near_and_the_other_far() -> None:
    """Of a floor 1 m below, at 1 m and at 10 m: no pixel needs the sizes of its texture in between."""
    camera = Intrinsics(fx=10.0, fy=1.0, cx=0.0, cy=-0.1, width=1, height=2)
    floor = Surface(
        np.array([0.0, -5.0, -1.0]), np.array([60.0, 0, 0]), np.array([0, 10.0, 0]), plain(120, side=128)
    )
    image = draw([floor], camera, AHEAD, np.zeros((2, 1, 3), np.float32))
    np.testing.assert_allclose(image, 120, atol=0.5)


def test_box_shows_the_light_of_the_side_that_faces_the_camera() -> None:
    sides = box((3.0, 0.0, 0.0), (1.0, 1.0, 1.0), 0.0, [plain(100)])
    image = draw(sides, CAMERA, AHEAD, BLACK)
    assert len(sides) == 6
    assert image[40, 50, 0] == pytest.approx(82, abs=0.5)


def test_look_has_camera_axes() -> None:
    R_world_cam = look(np.zeros(3), np.pi / 2, 0.0)[:3, :3]
    np.testing.assert_allclose(R_world_cam, [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)
    assert look(np.zeros(3), 0.0, 0.3)[2, 2] == pytest.approx(np.sin(0.3))
    rolled = look(np.zeros(3), 0.4, 0.3, 0.2)[:3, :3]
    np.testing.assert_allclose(rolled.T @ rolled, np.eye(3), atol=1e-12)
    assert np.linalg.det(rolled) == pytest.approx(1)


def test_depth_is_along_the_view_and_infinite_beside_what_there_is() -> None:
    depth = exact_depth([wall(2.0, 0.5, plain(200))], CAMERA, AHEAD)
    assert depth[15:65, 25:75] == pytest.approx(2.0, rel=1e-5)
    assert np.isinf(depth).sum() == depth.size - 50 * 50


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_depth_is_that_of_the_nearer_wall(order: tuple[int, int]) -> None:
    walls = [wall(2.0, 0.2, plain(200)), wall(4.0, 2.0, plain(80))]
    depth = exact_depth([walls[i] for i in order], CAMERA, AHEAD)
    assert depth[40, 50] == pytest.approx(2.0, rel=1e-5)
    assert depth[10, 10] == pytest.approx(4.0, rel=1e-5)


def test_points_at_the_depth_of_a_slanted_floor_lie_on_it() -> None:
    floor = Surface(
        np.array([-5.0, -5.0, -1.0]), np.array([60.0, 0, 0]), np.array([0, 10.0, 0]), plain(120), (6.0, 1.0)
    )
    camera_pose = look(np.array([0.3, -0.2, 0.5]), 0.2, -0.3, 0.1)
    depth = exact_depth([floor], CAMERA, camera_pose)
    ys, xs = np.nonzero(np.isfinite(depth))
    rays = np.linalg.inv(CAMERA.K) @ np.stack([xs, ys, np.ones(len(xs))])
    world = camera_pose[:3, :3] @ (rays * depth[ys, xs]) + camera_pose[:3, 3:]
    assert len(ys) > 3000
    np.testing.assert_allclose(world[2], -1.0, atol=1e-3)
