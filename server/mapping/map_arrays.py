"""What the arrays of a checkpoint have to be like for a map to be made of them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.common.shapes import check_shape
from semcast.server.mapping.readout import AXES, Readout

#: Shapes by name; a word stands for the same size wherever it occurs.
_SHAPES = {
    "landmarks.ids": "L",
    "landmarks.xyz": "L 3",
    "landmarks.rgb": "L 3",
    "landmarks.confidence": "L",
    "landmarks.submap": "L",
    "landmarks.born": "L",
    "landmarks.last_seen": "L",
    "landmarks.num_missed": "L",
    "keyframes.frame_id": "K",
    "keyframes.t_source_ns": "K",
    "keyframes.length": "K 5",
    "keyframes.ids": "O",
    "keyframes.xy": "O 2",
    "keyframes.confidence": "O",
    "keyframes.descriptor_ids": "D",
    "keyframes.descriptors": "D 32",
    "poses.frame_id": "P",
    "poses.T_world_cam": "P 4 4",
    "poses.submap": "P",
    "frames.frame_id": "F",
    "frames.keyframe_id": "F",
    "frames.T_keyframe_cam": "F 4 4",
}
#: Submaps whose place was guessed, and what the guesses are worth: all of these or none.
_GUESSES = {"guesses": "S 2", "guesses.is_known": "S", "guesses.covariance": "S 7 7"}
#: Of which keyframes it is known how far they may be off, and how far: both or none.
_DRIFT = {"drift.frame_id": "C", "drift.covariance": "C 7 7"}
#: Arrays that older checkpoints lack; so they do ``readout``.
_ADDED = {"revisits": "R 2", "gaps": "G", "keyframes.edge": "O 2", **_GUESSES, **_DRIFT}
#: Keyframes and frames refer to poses by frame id.
_OF_POSES = {"keyframes.frame_id": "keyframes", "frames.keyframe_id": "frames"}


def check_map_arrays(arrays: Mapping[str, NDArray], parts: tuple[str, ...]) -> None:
    """Check that arrays fit together and hold numbers.

    Args:
        arrays: By name; others than those of a map are not looked at.
        parts: Of a keyframe, in the order of the columns of ``keyframes.length``.

    Raises:
        KeyError: An array is missing.
        ValueError: Arrays contradict each other.
    """
    sizes: dict[str, int] = {}
    added = {name: shape for name, shape in _ADDED.items() if name in arrays}
    for first, group in (("guesses", _GUESSES), ("drift.frame_id", _DRIFT)):
        if first in arrays:
            added |= group
    for name, shape in {**_SHAPES, **added}.items():
        for word, size in check_shape(arrays[name], shape, name).items():
            if sizes.setdefault(word, size) != size:
                raise ValueError(f"{name} must have {sizes[word]} rows, got {size}")
        if arrays[name].dtype.kind == "f" and not np.isfinite(arrays[name]).all():
            raise ValueError(f"{name} must be finite")
    for part, length in zip(parts, arrays["keyframes.length"].T, strict=True):
        if (length < 0).any() or length.sum() != len(arrays[f"keyframes.{part}"]):
            raise ValueError(
                f"lengths of keyframes.{part} must add up to its {len(arrays[f'keyframes.{part}'])}"
            )
    if (np.diff(arrays["landmarks.ids"]) <= 0).any():
        raise ValueError("landmarks.ids must ascend")
    refer = [(arrays[name], what) for name, what in _OF_POSES.items()]
    if "guesses" in arrays:
        refer.append((arrays["guesses"][:, 1], "guesses"))
    if "drift.frame_id" in arrays:
        refer.append((arrays["drift.frame_id"], "drift"))
    for frame_ids, what in refer:
        unknown = np.setdiff1d(frame_ids, arrays["poses.frame_id"])
        if len(unknown):
            raise ValueError(f"{what} refer to keyframe {unknown[0]}, which is not there")


@dataclass(frozen=True)
class RunState:
    """What a run needs to go on, besides its map.

    Attributes:
        counters: Map epoch, submap, next track's id, newest frame's id.
        noise: ``(2,)`` of ``OnlineNoise``.
        readout: That images are put right for; None where a checkpoint does not tell.
    """

    counters: list[int]
    noise: NDArray[np.float64]
    readout: Readout | None

    def arrays(self) -> dict[str, NDArray]:
        """Return it as plain arrays."""
        readout = self.readout or Readout("rows", 0.0)
        return {
            "counters": np.array(self.counters, dtype=np.int64),
            "noise": self.noise,
            "readout": np.array([AXES.index(readout.axis), readout.signed_ms]),
        }

    @staticmethod
    def of(arrays: Mapping[str, NDArray]) -> "RunState":
        """Take what ``arrays`` gave.

        Raises:
            KeyError: An array is missing.
            ValueError: An array is not one of a run.
        """
        counters, noise = np.asarray(arrays["counters"]), np.asarray(arrays["noise"], dtype=np.float64)
        if counters.shape != (4,) or noise.shape != (2,) or not np.isfinite(noise).all():
            raise ValueError("counters and noise of a snapshot must have 4 and 2 finite values")
        if "readout" not in arrays:
            return RunState(counters.tolist(), noise, None)
        readout = np.asarray(arrays["readout"], dtype=np.float64)
        if readout.shape != (2,) or readout[0] not in (0.0, 1.0) or not np.isfinite(readout).all():
            raise ValueError(f"readout of a snapshot must be an axis and a time, got {readout}")
        return RunState(counters.tolist(), noise, Readout(AXES[int(readout[0])], float(readout[1])))
