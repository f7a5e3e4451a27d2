import numpy as np
import pytest

from semcast.channel.settings import ChannelSettings
from semcast.common.sequence import open_sequence
from semcast.evaluation.pipeline import FrameRun
from semcast.evaluation.reconstruct import cut_to_frames, reconstruct, split_bundle
from semcast.server.mapping.settings import ReconstructionSettings


@pytest.fixture
def sequence(room):
    return open_sequence(room)


def clean(sequence, frame_ids):
    return FrameRun(sequence, frame_ids, None, ChannelSettings(), seed=0)


def test_a_clean_sequence_is_followed_from_end_to_end(sequence):
    seen = []
    run = reconstruct(
        clean(sequence, range(24)),
        sequence.intrinsics,
        ReconstructionSettings(),
        sequence.groundtruth(),
        lambda frame, result, row, update: seen.append((frame.frame_id, row.frame_id, result.frame_id)),
    )
    assert seen == [(k, k, k) for k in range(24)]
    assert run.summary["completeness"] >= 0.95
    assert run.summary["ate_percent"] < 3.0
    assert run.summary["psnr_db"] is None
    assert run.num_landmarks > 50
    assert len(run.rows) == 24
    errors = [row["error_m"] for row in run.rows if row["error_m"] is not None]
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(run.summary["ate_rmse_m"])
    assert {"track", "map", "bundle"} <= set(run.summary["stage_ms"])


def test_poses_as_they_were_published_have_figures_of_their_own(sequence):
    published = {}
    run = reconstruct(
        clean(sequence, range(14)),
        sequence.intrinsics,
        ReconstructionSettings(),
        sequence.groundtruth(),
        lambda frame, result, row, update: published.update({frame.frame_id: result.T_world_cam}),
    )
    posed = [k for k, T_world_cam in published.items() if T_world_cam is not None]
    assert run.summary["completeness_at_once"] == pytest.approx(len(posed) / 14)
    # The frames before the start of the map got their poses later.
    assert run.summary["completeness_at_once"] < run.summary["completeness"]
    assert run.summary["ate_at_once_percent"] != run.summary["ate_percent"]
    assert run.summary["ate_at_once_percent"] < 5.0
    # Covariances as they come from the map: not off by orders of magnitude.
    assert 0.1 < run.summary["stated_ratio_trans"] < 10.0
    assert 0.1 < run.summary["stated_ratio_rot"] < 10.0


def test_lost_frames_count_against_completeness(sequence, phase_codec):
    settings = ChannelSettings(snr_db=25.0, frame_loss=0.25)
    frames = FrameRun(sequence, range(14), phase_codec, settings, seed=2)
    run = reconstruct(frames, sequence.intrinsics, ReconstructionSettings(), sequence.groundtruth())
    num_lost = sum(f.decoded is None for f in frames)
    assert num_lost > 1
    assert run.summary["drops"] == {"lost": num_lost}
    assert run.summary["completeness"] * 14 <= 14.01 - num_lost
    assert len(run.rows) == 14 - num_lost


def test_truth_is_cut_to_the_frames_that_were_sent(sequence):
    truth = sequence.groundtruth()
    times_ns = {k: int(sequence.times_ns[k]) for k in (2, 4, 6)}
    cut = cut_to_frames(truth, times_ns)
    np.testing.assert_array_equal(cut.T_world_cam, truth.T_world_cam[[2, 4, 6]])


def test_an_adjustment_in_line_is_taken_out_of_its_stage():
    split = split_bundle({"track": 3.0, "map": 50.0, "bundle": 7.0}, 40.0)
    assert split == {"track": 3.0, "map": 10.0, "bundle": 40.0}
    assert split_bundle({"track": 3.0, "bundle": 7.0}, 0.0) == {"track": 3.0}
    assert split_bundle({"two_view": 30.0}, 10.0) == {"two_view": 20.0, "bundle": 10.0}
