"""What the arrays of a checkpoint have to be like for a map to be made of them."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from semcast.common.shapes import check_shape

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
#: Arrays that older checkpoints lack.
_ADDED = {"revisits": "R 2"}
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
    for name, what in _OF_POSES.items():
        unknown = np.setdiff1d(arrays[name], arrays["poses.frame_id"])
        if len(unknown):
            raise ValueError(f"{what} refer to keyframe {unknown[0]}, which is not there")
