"""What passes before a camera at rest: it is no motion of the scene, however much of the view it takes up."""

import numpy as np
from drawn_boards import FRAME_NS, ate_percent, board_texture, frame_of, make, render, sideways

from semcast.server.mapping.passing import Passing
from semcast.server.mapping.sight import Sight

WIDTH, HEIGHT = 480, 160
#: A track in each of 24 x 8 places.
PLACES = np.stack(np.meshgrid(np.arange(10.0, WIDTH, 20), np.arange(10.0, HEIGHT, 20)), axis=-1).reshape(
    -1, 2
)
NUM = 2 * len(PLACES)
IDS = np.arange(len(PLACES))


def tell(passing, k, motion_px, *, fixed=None, xy=PLACES, ids=IDS):
    sight = Sight(frame_of(k, None), np.zeros((HEIGHT, WIDTH), np.uint8), np.ones(HEIGHT, bool))
    fixed = np.zeros(len(xy), bool) if fixed is None else fixed
    return passing.scene_motion_px(sight, ids, xy, motion_px, np.zeros(len(xy)), fixed)


def under(left, right):
    """Tracks between two columns, which move by 20 px; the others stand."""
    return np.where((PLACES[:, 0] > left) & (PLACES[:, 0] < right), 20.0, 0.0)


def cross(passing, num, first=0):
    """Something as wide as 0.7 of the image comes in from the left, 40 px with each frame."""
    return [tell(passing, k, under(40 * k - 336, 40 * k)) for k in range(first, first + num)]


def test_what_hides_and_uncovers_what_stands_passes_before_it():
    passing = Passing(NUM)
    moved_px = cross(passing, 12)
    assert passing.camera_stands
    assert moved_px[-4:] == [0.0] * 4, "it covers most of the image"


def test_what_moves_beside_something_that_always_stands_is_the_scene():
    passing = Passing(NUM)
    behind = np.where(PLACES[:, 1] < 120, 20.0, 0.0)
    assert [tell(passing, k, behind) for k in range(40)] == [20.0] * 40
    assert not passing.camera_stands


def test_the_outline_of_a_bonnet_changes_for_ever_and_tells_nothing():
    passing = Passing(NUM)
    outline = np.flatnonzero(PLACES[:, 1] == 130)
    for k in range(60):
        # Some places at its outline show now the bonnet and now the road.
        motion_px = np.where(PLACES[:, 1] < 120, 20.0, 0.0)
        motion_px[outline[::6]] = 20.0 * (k % 2)
        assert tell(passing, k, motion_px) == 20.0, k


def test_what_is_known_to_move_with_the_camera_is_not_hidden():
    passing, fixed = Passing(NUM), np.ones(len(PLACES), bool)
    for k in range(12):
        tell(passing, k, under(40 * k - 336, 40 * k), fixed=fixed)
    assert not passing.camera_stands


def test_all_of_the_scene_sets_off_and_stops_at_once():
    passing = Passing(NUM)
    for k in range(40):
        tell(passing, k, np.full(len(PLACES), 20.0 if k // 5 % 2 else 0.0))
        assert not passing.camera_stands, k


def test_a_camera_sets_off_when_what_stood_moves():
    passing = Passing(NUM)
    cross(passing, 8)
    assert passing.camera_stands
    assert tell(passing, 8, np.full(len(PLACES), 9.0), xy=PLACES + 9.0) == 9.0
    assert not passing.camera_stands


def test_what_stood_is_known_by_the_ids_that_tracks_are_given_for_another_part_of_the_map():
    passing, ids = Passing(NUM), IDS + 5000
    cross(passing, 8)
    passing.renew(IDS[:0], IDS[:0])  # where no track is left, what stood is still remembered
    passing.renew(IDS, ids)
    assert tell(passing, 8, np.full(len(PLACES), 9.0), xy=PLACES + 9.0, ids=ids) == 9.0
    assert not passing.camera_stands


def test_what_hides_everything_passes_for_two_seconds():
    passing = Passing(NUM)
    cross(passing, 8)
    hides = {"motion_px": np.full(len(PLACES), 20.0), "ids": IDS + len(IDS)}
    moved_px = [tell(passing, k, **hides) for k in range(8, 60)]
    first = 8 + moved_px.index(20.0)
    assert 1.8 < (first - 7) * FRAME_NS * 1e-9 < 2.3


def test_what_near_posts_hide_and_what_drifts_by_slowly_is_no_proof_that_the_camera_stands():
    """Hills behind a fence drift by 0.7 px a frame, less than tells one frame from the next."""
    passing, since, most = Passing(NUM), 0, 0
    for k in range(60):
        is_post = (PLACES[:, 0] - 12 * k) % 120 < 50
        # Where a post was, the hills come back as new tracks.
        ids = np.where(is_post, 10_000 + k * len(IDS) + IDS, 100_000 * ((PLACES[:, 0] - 12 * k) // 120) + IDS)
        ids, row = np.unique(ids.astype(np.int64), return_index=True)
        xy = (PLACES + np.array([0.7 * k, 0.0]))[row]
        tell(passing, k, np.where(is_post, 12.0, 0.7)[row], xy=xy, ids=ids)
        since = since + 1 if passing.camera_stands else 0
        most = max(most, since)
    assert most <= 3, "a map can begin in between"


def test_a_frame_that_is_looked_at_again_counts_once():
    once, again = Passing(NUM), Passing(NUM)
    for k in range(12):
        moved_px = tell(once, k, under(40 * k - 336, 40 * k))
        tell(again, k, np.where(under(40 * k - 336, 40 * k) > 0, 0.0, 20.0))
        assert tell(again, k, under(40 * k - 336, 40 * k)) == moved_px
        assert again.camera_stands == once.camera_stands, k
    assert once.camera_stands


def test_a_map_begins_with_the_scene_when_the_camera_sets_off_from_behind_crossing_traffic():
    """Boards that take up more than half of the view cross one after the other, in both directions."""
    path = [sideways(1)[0]] * 40 + sideways()
    boards = [board_texture(k, 220)[:, :, None] for k in range(20, 23)]
    reconstruction = make()
    for k, T_world_cam in enumerate(path):
        image = render(T_world_cam)
        for n, board in enumerate(boards):
            left = 22 * (k - 2 - 13 * n) - 220
            left = left if n % 2 else 320 - 220 - left
            begin, end = max(left, 0), min(left + 220, 320)
            if k < 40 and begin < end:
                image[10:230, begin:end] = board[:, begin - left : end - left]
        reconstruction.process(frame_of(k, image))
    trajectory = reconstruction.final_trajectory()
    reconstruction.close()
    assert set(trajectory) >= set(range(40, len(path)))
    assert ate_percent(trajectory, path) < 1.0
