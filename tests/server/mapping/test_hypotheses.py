"""Structures a start may be go on with later frames, each as itself."""

from dataclasses import replace

import numpy as np

from semcast.server.geometry.weighting import NoiseModel
from semcast.server.mapping.ambiguity import Structure
from semcast.server.mapping.depth_reversal import mirrored
from semcast.server.mapping.hypotheses import hypothesis_of, poses_in, problem_of
from semcast.server.mapping.kept_frames import Observed

NOISE = NoiseModel(0.5, 0.0)


def views_of(problem):
    """The frames a problem was made of."""
    return [
        Observed(k, k * 10**8, problem.point[mine], problem.xy[mine], np.ones(int(mine.sum())))
        for k, mine in ((k, problem.view == k) for k in range(len(problem.T_world_cam)))
    ]


def only(view, sees):
    """Return a frame with a part of its tracks."""
    return replace(
        view, ids=view.ids[sees], xy=view.xy[sees], confidence=view.confidence[sees], edge=view.edge[sees]
    )


def test_later_frames_are_posed_in_the_structure_of_earlier_ones(arc):
    truth = arc(focal_px=600.0, depth=4.0, noise_px=0.3, num_views=8, turn_deg=16.0)
    camera, views = truth.camera, views_of(truth)
    first = hypothesis_of(
        Structure(truth.T_world_cam[:5], truth.xyz, 0.0, True, 0.7), views[:5], camera, NOISE
    )
    assert first.doubt == 0.7
    assert len(first.ids) > 100
    T = poses_in(first, views[2:], camera, NOISE, seed=0)
    np.testing.assert_allclose(T[:3], truth.T_world_cam[2:5], atol=1e-12)
    np.testing.assert_allclose(T[3:], truth.T_world_cam[5:], atol=0.02)


def test_a_mirror_image_stays_one_in_later_frames(arc, direction_error_deg):
    truth = arc(focal_px=2000.0, depth=12.0, noise_px=0.2, num_views=6, turn_deg=6.0)
    camera, views = truth.camera, views_of(truth)
    other = mirrored(truth)
    carried = hypothesis_of(Structure(other.T_world_cam[:4], other.xyz, 0.0, True), views[:4], camera, NOISE)
    T = poses_in(carried, [views[0], views[4], views[5]], camera, NOISE, seed=0)
    assert direction_error_deg(T, truth.T_world_cam) > 90.0


def test_a_structure_ends_with_the_frames_that_share_nothing_with_it(arc):
    truth = arc(focal_px=600.0, depth=4.0)
    camera, views = truth.camera, views_of(truth)
    first = hypothesis_of(Structure(truth.T_world_cam, truth.xyz, 0.0, True), views, camera, NOISE)
    elsewhere = Observed(9, 9 * 10**8, views[0].ids + 1000, views[0].xy, views[0].confidence)
    assert poses_in(first, [views[0], elsewhere], camera, NOISE, seed=0) is None


def test_all_structures_are_judged_by_the_same_observations(arc):
    truth = arc(focal_px=600.0, depth=4.0, noise_px=0.3)
    camera, views = truth.camera, views_of(truth)
    right = problem_of(views, truth.T_world_cam, camera, NOISE)
    other = problem_of(views, mirrored(truth).T_world_cam, camera, NOISE)
    for name in ("landmark_ids", "view", "point", "xy", "sigma_px", "keyframe_ids"):
        np.testing.assert_array_equal(getattr(right, name), getattr(other, name))
    assert len(right.landmark_ids) == 90, "the longest tracks"
    np.testing.assert_allclose(right.xyz, truth.xyz[right.landmark_ids], atol=0.2)
    assert np.isfinite(other.xyz).all()


def test_what_two_views_saw_counts_and_what_one_saw_alone_does_not(arc):
    truth = arc(focal_px=600.0, depth=4.0, noise_px=0.3, num_views=3, turn_deg=8.0)
    views = views_of(truth)
    parts = (slice(1, 9), slice(0, 8), slice(1, 8))
    views = [only(view, sees) for view, sees in zip(views, parts, strict=True)]
    problem = problem_of(views, truth.T_world_cam, truth.camera, NOISE)
    assert len(problem.xyz) == 7, "the first and the last of the nine are seen once"
    views[2] = only(views[2], slice(0, 6))
    assert len(problem_of(views, truth.T_world_cam, truth.camera, NOISE).xyz) == 7, "twice is enough"
