"""What the guess of where a submap is does to the poses in it."""

import numpy as np

from semcast.common.geometry import exp_se3, invert_transform, log_so3
from semcast.server.mapping.guessed_place import GuessedPlace

T_WORLD_FIRST = exp_se3([0.3, -0.2, 1.0, 4.0, 5.0, 6.0])
T_FIRST_CAM = exp_se3([0.1, 0.9, -0.3, 1.0, -2.0, 7.0])


def moved(similarity):
    """A camera of a submap whose first camera is moved by a small similarity, in its own frame."""
    T = T_FIRST_CAM.copy()
    T[:3, 3] *= np.exp(similarity[6])
    return T_WORLD_FIRST @ exp_se3(similarity[:6]) @ T


def test_a_pose_is_off_by_what_the_first_camera_is_off_and_the_lever_to_it():
    rng = np.random.default_rng(0)
    root = 1e-3 * rng.normal(size=(7, 7))
    T_there = T_WORLD_FIRST @ T_FIRST_CAM
    off = []
    for similarity in rng.normal(size=(4000, 7)) @ root.T:
        apart = invert_transform(T_there) @ moved(similarity)
        off.append([*log_so3(apart[:3, :3]), *apart[:3, 3], similarity[6]])
    found = GuessedPlace(3, root @ root.T).seen_from(T_FIRST_CAM)
    sd = np.sqrt(np.diag(found))
    np.testing.assert_allclose(
        np.cov(np.transpose(off)) / np.outer(sd, sd), found / np.outer(sd, sd), atol=0.1
    )


def test_it_is_carried_on_from_camera_to_camera():
    guess = GuessedPlace(3, np.diag([1.0, 2, 3, 4, 5, 6, 7]))
    half = exp_se3([0.0, 0.4, 0.0, 1.0, 2.0, 3.0])
    on = GuessedPlace(4, guess.seen_from(half)).seen_from(invert_transform(half) @ T_FIRST_CAM)
    np.testing.assert_allclose(on, guess.seen_from(T_FIRST_CAM), atol=1e-9)


def test_of_an_unknown_place_nothing_is_known_anywhere():
    nowhere = GuessedPlace(3, None)
    assert nowhere.seen_from(T_FIRST_CAM) is None
