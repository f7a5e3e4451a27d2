"""How far an answer may be trusted that comes from what adjustments leave over."""

from types import SimpleNamespace

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.evaluation.moving_images import Heard, _Listening
from semcast.server.mapping.left_over import NUM_GROUPS, spread


@pytest.mark.parametrize("share_left", [1.0, 0.64])
def test_bounds_of_95_percent_cover_the_truth_so_often(share_left):
    says = np.random.default_rng(5).normal(0.0, 3.0, (20_000, NUM_GROUPS))  # the truth is 0
    without_one = (says.sum(axis=1, keepdims=True) - says) / (NUM_GROUPS - 1)
    heard = Heard([], 0.2, 60, share_left)
    seen = np.sqrt(share_left)  # of the scatter, in residuals
    reach = np.array([heard.reach_95(seen * spread(estimates)) for estimates in without_one])
    assert (np.abs(says.mean(axis=1)) <= reach).mean() == pytest.approx(0.95, abs=0.0045)


def test_what_a_keyframe_says_in_two_windows_counts_as_of_one_witness():
    bundle = _Listening(Intrinsics(fx=1.0, fy=1.0, cx=0.0, cy=0.0, width=8, height=8))
    assert (bundle.views, bundle.share_left) == ([], 1.0)
    for keyframe_ids in ([3, 1, 2], [2, 3, 4]):
        # 40 points in three views each, of which one observation is not used.
        residual_px = np.zeros((120, 2))
        residual_px[7, 1] = np.nan
        problem = SimpleNamespace(
            keyframe_ids=np.array(keyframe_ids),
            view=np.repeat(np.arange(3), 40),
            point=np.tile(np.arange(40), 3),
        )
        left_over = np.stack([np.full((8, 8), float(k)) for k in keyframe_ids])
        bundle._note(SimpleNamespace(problem=problem, residual_px=residual_px), left_over)
    assert [view[0, 0] for view in bundle.views] == [1.0, 4.0, 6.0, 4.0]
    assert bundle.share_left == pytest.approx(1.0 - (6 * 3 + 3 * 40) / (2 * 119))
