"""Frames of which an outage of the link let little through: located, and nothing built on them."""

import numpy as np
import pytest
from drawn_boards import CAMERA, ate_percent, frame_of, make

from semcast.common.phy.slots import BLOCK_PX
from semcast.server.mapping.outage import Outage, share_received
from semcast.server.mapping.state import DecodedFrame, TrackingState

_NUM_SLOTS = CAMERA.height // BLOCK_PX


def slots(num_lost, snr_db=15.0):
    snr = np.full(_NUM_SLOTS, snr_db, np.float32)
    snr[:num_lost] = -20.0
    return snr


def frame_with(share, k, image):
    return frame_of(k, image, slot_snr_db=slots(_NUM_SLOTS - round(share * _NUM_SLOTS)))


@pytest.mark.parametrize(
    ("snr_db", "share"),
    [([15.0] * 4, 1.0), ([-20.0] * 4, 0.0), ([15.0, -20.0] * 2, 0.5), ([-5.0] * 4, 1.0), ([-15.0], 0.1)],
)
def test_a_slot_counts_by_what_it_holds(room, snr_db, share):
    frame = frame_of(0, room[1][0], slot_snr_db=np.array(snr_db, np.float32))
    assert share_received(frame) == pytest.approx(share, abs=0.05)


def test_slots_of_which_nothing_is_known_count_in_full_and_nan_as_lost(room):
    image = room[1][0]
    assert share_received(frame_of(0, image)) == 1.0
    assert share_received(frame_of(0, image, slot_snr_db=np.zeros(0, np.float32))) == 1.0
    assert share_received(frame_of(0, image, slot_snr_db=np.array([np.nan, 10.0], np.float32))) == 0.5


def test_an_outage_is_told_by_what_came_before_and_is_over_when_it_lasts(room):
    outage, image = Outage(), room[1][0]
    assert not outage.takes(frame_with(0.4, 0, image)), "nothing better is known"
    for k in range(1, 21):  # ten frames a second
        assert not outage.takes(frame_with(1.0, k, image))
    took = [outage.takes(frame_with(0.4, k, image)) for k in range(21, 51)]
    assert took[:14] == [True] * 14
    assert not any(took[16:]), "the link is like that now"


@pytest.mark.parametrize("step_ns", [0, -10_000_000_000])
def test_times_that_stand_still_or_begin_again_are_expected(room, step_ns):
    outage, image = Outage(), room[1][0]
    for k in range(300):
        outage.takes(DecodedFrame(k, k * step_ns, image, slot_snr_db=slots(0)))
    assert len(outage._shares) <= 121
    took = [outage.takes(DecodedFrame(k, 300 * step_ns, image, slot_snr_db=slots(10))) for k in range(200)]
    assert took[0] == (step_ns == 0)
    assert not took[-1]


def test_a_link_that_loses_one_slot_in_five_has_no_outage(room):
    outage, image, rng = Outage(), room[1][0], np.random.default_rng(3)
    taken = 0
    for k, num_lost in enumerate(rng.binomial(_NUM_SLOTS, 0.2, 1000).tolist()):
        taken += outage.takes(frame_of(k, image, slot_snr_db=slots(num_lost, 6.0)))
    assert taken <= 5


def through_outage(images, lost, rng):
    """Frames of which some arrive with a quarter of their rows, noise in all others."""
    for k, image in enumerate(images):
        if k not in lost:
            yield frame_of(k, image, slot_snr_db=slots(0))
            continue
        snr = slots(0)
        snr[rng.permutation(_NUM_SLOTS)[: round(0.75 * _NUM_SLOTS)]] = -20.0
        rows = np.repeat(snr < 0, BLOCK_PX)
        guessed = image.copy()
        guessed[rows] = rng.integers(60, 190, guessed[rows].shape)
        yield frame_of(k, guessed, slot_snr_db=snr)


def test_nothing_is_built_on_an_outage_and_tracks_outlive_it(room):
    poses, images = room
    lost = range(8, 13)
    reconstruction = make()
    results = [reconstruction.process(f) for f in through_outage(images, lost, np.random.default_rng(1))]
    before, after = results[lost[0] - 1], results[lost[-1] + 1]
    assert before.state is after.state is TrackingState.TRACKING
    for k in lost:
        assert not results[k].is_keyframe
        assert results[k].state is TrackingState.TRACKING
    assert after.T_world_cam is not None
    assert after.num_inliers >= 0.5 * before.num_inliers
    assert {r.submap for r in results} == {0}
    assert {k.frame_id for k in reconstruction.world.keyframes}.isdisjoint(lost)
    trajectory = reconstruction.final_trajectory()
    reconstruction.close()
    assert ate_percent(trajectory, poses) < 1.0


def test_a_camera_that_sees_something_else_by_now_goes_on_from_an_outage(room):
    _, images = room
    reconstruction = make()
    for k in range(8):
        reconstruction.process(frame_of(k, images[k], slot_snr_db=slots(0)))
    half = slots(_NUM_SLOTS // 2)
    through = [reconstruction.process(frame_of(k, images[k], slot_snr_db=half)) for k in (9, 12, 15)]
    reconstruction.close()
    assert all(r.num_tracked > 0 for r in through)
    assert any(r.is_keyframe for r in through)


def test_a_pose_of_an_outage_is_told_and_kept_like_any_other(room):
    _, images = room
    reconstruction, told = make(), []
    outage = range(8, 11)
    for f in through_outage(images, (), np.random.default_rng(2)):
        if f.frame_id in outage:  # what is left of it tells where it is
            snr = slots(round(0.47 * _NUM_SLOTS))
            image = f.image.copy()
            image[np.repeat(snr < 0, BLOCK_PX)] = 128
            f = frame_of(f.frame_id, image, slot_snr_db=snr)
        reconstruction.process(f, told.append)
    located = [r for r in told if r.frame_id in outage]
    assert located
    assert all(r.num_inliers >= 15 for r in located)
    trajectory = reconstruction.final_trajectory()
    reconstruction.close()
    for r in located:
        assert r.T_world_cam is not None
        assert np.isfinite(trajectory[r.frame_id]).all()
