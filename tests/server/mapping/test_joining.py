"""Which places may join two parts of a map."""

import numpy as np
import pytest

from semcast.common.geometry import exp_so3, make_transform
from semcast.server.mapping.joining import may_join
from semcast.server.mapping.world_map import Keyframe

FRAME_S = 0.1
#: The camera went on by so much with every frame, in map units; so far away is the scene.
STEP, DEPTH = 0.2, 1.0


def part(first_id, num, submap, step=STEP):
    """Keyframes of a part that begins at the origin, of every frame."""
    none = np.zeros(0, np.int64)
    return [
        Keyframe(
            *(first_id + k, round((first_id + k) * FRAME_S * 1e9)),
            *(make_transform(np.eye(3), (step * k, 0.0, 0.0)), submap),
            *(none, np.zeros((0, 2)), np.zeros(0)),
        )
        for k in range(num)
    ]


def ids_of(*parts):
    return np.array([k.frame_id for keyframes in parts for k in keyframes])


def joined(x, scale=1.0, turn_deg=0.0, gap_frames=10, num_newer=3):
    """Whether a part that begins after a gap, in half the unit or so, may begin at x in the older one."""
    older = part(0, 30, 0)
    newer = part(29 + gap_frames, num_newer, 1, STEP / scale)
    T_join = make_transform(exp_so3((0.0, 0.0, np.radians(turn_deg))), (x, 0.0, 0.0))
    return may_join(older, newer, scale, T_join, posed_ids=ids_of(older, newer), depth=DEPTH)


#: Where the camera was last, and where it must be after ten frames.
LAST, THERE = 29 * STEP, 39 * STEP


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_a_part_begins_where_the_camera_can_be(scale):
    assert joined(THERE, scale)
    assert joined(THERE - 1.0, scale)
    assert not joined(LAST - 0.5, scale), "the door before"
    assert not joined(THERE + 2.5, scale), "the next door"


def test_a_long_part_may_begin_further_off():
    assert not joined(THERE - 1.8)
    assert joined(THERE - 1.8, num_newer=30), "its unit is not exactly what the place says"


def test_after_a_long_gap_the_camera_is_anywhere():
    assert joined(LAST - 0.5, gap_frames=40)


def test_where_a_recording_was_cut_the_camera_is_anywhere():
    assert joined(LAST - 50.0, gap_frames=1)


@pytest.mark.parametrize(
    ("turn_deg", "gap_frames", "may"),
    [(20.0, 1, True), (90.0, 2, False), (90.0, 12, True), (179.0, 30, True)],
)
def test_a_part_after_a_short_gap_is_not_turned_into_another_corridor(turn_deg, gap_frames, may):
    assert joined(LAST + gap_frames * STEP, turn_deg=turn_deg, gap_frames=gap_frames) == may


def test_what_did_not_come_before_tells_nothing():
    older, newer = part(50, 10, 0), part(0, 10, 1)
    T_join = make_transform(np.eye(3), (90.0, 0.0, 0.0))
    assert may_join(older, newer, 1.0, T_join, posed_ids=ids_of(newer, older), depth=DEPTH)
