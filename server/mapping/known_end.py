"""Places a part of the map by its end, when the camera comes back from it to a part that was there before.

Who turns round at the end of a corridor, goes back and turns round again has lost the map twice and sees the
first corridor again. Where the part between begins, and its unit, was guessed; where it ends is known now,
and both together tell where all of it is: the guess and the end are weighted with what they are worth.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semcast.common.geometry import exp_so3, log_so3, make_transform, skew

Array = NDArray[np.float64]

#: Where nothing is known of the place of a part, this is: standard deviations of its turn in radians, of its
#: place as share of the scene's depth, and of the logarithm of its unit.
_ANYWHERE = (1.0, 10.0, 0.5)
#: No guess is better than this, in the same units: the past of a steady camera would promise any precision.
_LEAST = (0.01, 0.02, 0.01)
#: Tracking drifts: where the part ends is off by this share of the way to there, beside what the gap adds.
_DRIFT_SHARE = 0.02
#: A pose that was found is off by this share of the scene's depth at least.
_FOUND_SHARE = 0.001
#: The guess and the end contradict each other beyond this sum of squared errors in standard deviations: the
#: 99.9 % quantile of chi-squared with six degrees of freedom. One of them is wrong, and nothing tells which.
_MOST_APART = 22.5
_ITERATIONS = 10


class Placed(NamedTuple):
    """A similarity in the frame of a part's first camera, and what the place is worth then.

    Attributes:
        scale: Factor on lengths.
        T: ``(4, 4)``; ``T @ (scale * x)`` is where a point of the part is.
        covariance: ``(7, 7)`` as of ``GuessedPlace``.
    """

    scale: float
    T: Array
    covariance: Array


def place_by_end(
    guessed: Array | None, T_first_led: Array, T_first_found: Array, sigma: tuple[float, float], depth: float
) -> Placed | None:
    """Weigh the guess of a part's place with where the camera was found after it.

    Gauss-Newton on the seven unknowns, the guess being their prior.

    Args:
        guessed: ``(7, 7)`` covariance of the guess, see ``GuessedPlace``; None where nothing is known.
        T_first_led: ``(4, 4)`` pose to which the part leads, in the frame of its first camera.
        T_first_found: ``(4, 4)`` the pose that was found, in the same frame as it is placed by the guess.
        sigma: How far off the first is because of the gap before it: standard deviations per axis, of the
            turn in radians and of the place in map units.
        depth: Of the scene, map units.

    Returns:
        Where the part is; None where guess and end contradict each other.
    """
    worth = _variances(_ANYWHERE, depth) if guessed is None else guessed + _variances(_LEAST, depth)
    prior = np.linalg.inv(worth)
    t_led = T_first_led[:3, 3]
    drift = _DRIFT_SHARE * float(np.linalg.norm(t_led))
    place_sigma = float(np.linalg.norm([sigma[1], drift, _FOUND_SHARE * depth]))
    weight = np.repeat((sigma[0], place_sigma), 3) ** -2.0
    turned, place, log_scale = np.eye(3), np.zeros(3), 0.0
    for _ in range(_ITERATIONS):
        led = np.exp(log_scale) * (turned @ t_led)
        turn_left = log_so3(T_first_found[:3, :3] @ (turned @ T_first_led[:3, :3]).T)
        error = np.concatenate([turn_left, T_first_found[:3, 3] - led - place])
        jacobian = np.zeros((6, 7))
        jacobian[:3, :3] = jacobian[3:, 3:6] = np.eye(3)
        jacobian[3:, :3] = -skew(led)
        jacobian[3:, 6] = led
        off = np.concatenate([log_so3(turned), place, [log_scale]])
        information = prior + jacobian.T @ (weight[:, None] * jacobian)
        step = np.linalg.solve(information, jacobian.T @ (weight * error) - prior @ off)
        turned = exp_so3(step[:3]) @ turned
        place, log_scale = place + step[3:6], log_scale + float(step[6])
    apart = float(off @ prior @ off + error @ (weight * error))
    if not apart <= _MOST_APART:
        return None
    # From here on the first camera's frame is the one it is turned to.
    to_turned = np.eye(7)
    to_turned[:3, :3] = to_turned[3:6, 3:6] = turned.T
    covariance = to_turned @ np.linalg.inv(information) @ to_turned.T
    return Placed(float(np.exp(log_scale)), make_transform(turned, place), covariance)


def _variances(sigma: tuple[float, float, float], depth: float) -> Array:
    turn, place, log_scale = sigma
    return np.diag(np.repeat((turn, place * depth, log_scale), (3, 3, 1)) ** 2)
