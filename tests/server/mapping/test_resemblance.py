"""Behind a gap a pose must rest on tracks that show what they showed before it."""

import pytest

from semcast.common.geometry import rotation_angle_deg
from semcast.common.sequence import open_sequence
from semcast.server.mapping.bundle import InlineBundle
from semcast.server.mapping.reconstruction import Reconstruction
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.state import DecodedFrame, TrackingState

#: Frames before the gap.
NUM_BEFORE = 12


@pytest.fixture(scope="module")
def orbit(orbit_folder):
    return open_sequence(orbit_folder)


def behind_a_gap(sequence, num_missing):
    """Result of the first frame behind it, and all poses."""
    reconstruction = Reconstruction(sequence.intrinsics, ReconstructionSettings(), InlineBundle())
    results = {}
    for k in (*range(NUM_BEFORE), *range(NUM_BEFORE + num_missing, len(sequence))):
        frame = DecodedFrame(k, int(sequence.times_ns[k]), sequence.image(k))
        results[k] = reconstruction.process(frame)
    poses = reconstruction.final_trajectory()
    reconstruction.close()
    assert results[NUM_BEFORE - 1].state is TrackingState.TRACKING
    return results[NUM_BEFORE + num_missing], poses


@pytest.mark.slow
def test_what_klt_finds_by_chance_is_no_pose(orbit):
    """35 degrees on, next to nothing looks as it did, yet KLT finds something near where the motion leads."""
    first, poses = behind_a_gap(orbit, 10)
    assert first.state is TrackingState.LOST
    assert first.T_world_cam is None
    assert set(range(NUM_BEFORE)) <= set(poses)


def test_what_looks_as_it_did_is_gone_on_from(orbit):
    first, poses = behind_a_gap(orbit, 4)
    assert first.state is TrackingState.TRACKING
    assert sorted(poses) == [*range(NUM_BEFORE), *range(NUM_BEFORE + 4, len(orbit))]
    truth = orbit.groundtruth().T_world_cam
    before, after = NUM_BEFORE - 1, NUM_BEFORE + 4
    estimated, true = (T[before][:3, :3].T @ T[after][:3, :3] for T in (poses, truth))
    assert rotation_angle_deg(estimated.T @ true) < 0.5
