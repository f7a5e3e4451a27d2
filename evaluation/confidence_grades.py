"""Grade confidence maps against what really happened to pixels, keypoints and slots.

Each grader takes frames one by one and keeps only what its figures need. Rival maps made from the decoded
image alone stand beside the codec's: a confidence that loses to them is not worth its bits.
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semcast.common.codec import LOST_SLOT_SNR_DB, DecodedImage, displacement_px
from semcast.common.phy.slots import BLOCK_PX as SLOT_PX
from semcast.evaluation.calibration import normalised_ause, reliability
from semcast.evaluation.match_truth import displacement_from_original_px
from semcast.evaluation.statistics import finite_mean, spearman
from semcast.evaluation.uncertainty_maps import (
    GRADED,
    absolute_error,
    block_means,
    gradient_energy,
    lambda_min,
    pixel_label,
    sample_at,
)

#: Corners per frame for the keypoint grades.
_MAX_CORNERS = 500
_CORNER_QUALITY = 0.01
_CORNER_DISTANCE_PX = 8
#: A corner that Lucas-Kanade finds further away than this was not found but confused with another.
_MAX_DISPLACEMENT_PX = 10.0
_NUM_QUANTILES = 8


class PixelGrader:
    """Grades ``DecodedImage.confidence`` as a prediction of the pixel error.

    Args:
        alpha: Sensitivity of the label the codec was trained on.
    """

    def __init__(self, alpha: float) -> None:
        self._alpha = alpha
        self._predicted: list[NDArray[np.float32]] = []
        self._observed: list[NDArray[np.float32]] = []
        self._grades: dict[str, dict[str, list[float | None]]] = {}

    def add(self, decoded: DecodedImage, original: NDArray[np.uint8]) -> None:
        """Take one frame: its decoded image with confidence and its original, same shape."""
        error = absolute_error(decoded.image, original)
        self._predicted.append(decoded.confidence[GRADED].ravel().copy())
        self._observed.append(pixel_label(decoded.image, original, self._alpha)[GRADED].ravel())
        maps = {
            "confidence": 1.0 - decoded.confidence,
            "constant": np.zeros_like(error),
            "gradient_energy": gradient_energy(decoded.image),
        }
        for name, uncertainty in maps.items():
            grades = self._grades.setdefault(name, {"nause": [], "spearman_pixel": [], "spearman_block": []})
            grades["nause"].append(normalised_ause(uncertainty[GRADED], error[GRADED]))
            grades["spearman_pixel"].append(spearman(uncertainty[GRADED], error[GRADED]))
            grades["spearman_block"].append(spearman(block_means(uncertainty), block_means(error)))

    def result(self) -> dict[str, Any]:
        """Return ``ece`` and ``reliability`` over all pixels, and per map the mean grades of its frames.

        ``nause``: 0 is the order of the true errors, 1 a random order. ``spearman_*``: of uncertainty and
        absolute error, 1 is best. None where a figure is not defined, as for the rank of a constant.
        """
        if not self._predicted:
            return {"ece": None, "reliability": None, "maps": {}}
        table = reliability(
            np.clip(np.concatenate(self._predicted), 0.0, 1.0), np.concatenate(self._observed)
        )
        maps = {
            name: {key: finite_mean(values) for key, values in grades.items()}
            for name, grades in self._grades.items()
        }
        return {"ece": table.ece, "reliability": table, "maps": maps}


class KeypointGrader:
    """Grades maps as predictions of how far a corner is displaced from the original to the decoded image."""

    def __init__(self) -> None:
        self._displacement_px: list[NDArray[np.float64]] = []
        self._uncertainty: dict[str, list[NDArray[np.float32]]] = {}
        self._num_corners = 0
        self._num_lost = 0

    def add(self, decoded: DecodedImage, original: NDArray[np.uint8]) -> None:
        """Take one frame; its corners are those of the decoded image, as the server sees them."""
        grey = cv2.cvtColor(decoded.image, cv2.COLOR_RGB2GRAY)
        corners = cv2.goodFeaturesToTrack(grey, _MAX_CORNERS, _CORNER_QUALITY, _CORNER_DISTANCE_PX)
        if corners is None:
            return
        points_xy = corners.reshape(-1, 2).astype(np.float64)
        moved_px, found = displacement_from_original_px(decoded.image, original, points_xy)
        found &= moved_px < _MAX_DISPLACEMENT_PX
        self._num_corners += len(points_xy)
        self._num_lost += int((~found).sum())
        points_xy = points_xy[found]
        self._displacement_px.append(moved_px[found])
        inverse = 1.0 / lambda_min(decoded.image)
        uncertain = 1.0 - decoded.confidence
        maps = {
            "confidence": uncertain,
            "inverse_lambda_min": inverse,
            "confidence_over_lambda_min": uncertain**2 * inverse,
            "gradient_energy": gradient_energy(decoded.image),
        }
        if decoded.keypoint_confidence is not None:
            maps["keypoint_confidence"] = displacement_px(decoded.keypoint_confidence)
        for name, uncertainty in maps.items():
            self._uncertainty.setdefault(name, []).append(sample_at(uncertainty, points_xy))

    def result(self) -> dict[str, Any]:
        """Return per map ``spearman`` and ``nause`` with the true displacement over all corners.

        ``calibration`` holds, for corners sorted by predicted displacement into equal parts, the mean
        prediction and the mean truth in pixels; None where the codec predicts no displacement.
        """
        truth = np.concatenate(self._displacement_px) if self._displacement_px else np.zeros(0)
        maps: dict[str, Any] = {}
        for name, parts in sorted(self._uncertainty.items()):
            # A map is graded only if every frame had it: figures over different corners don't compare.
            if len(parts) != len(self._displacement_px) or len(truth) == 0:
                continue
            uncertainty = np.concatenate(parts)
            maps[name] = {
                "spearman": spearman(uncertainty, truth),
                "nause": normalised_ause(uncertainty, truth),
            }
        calibration = None
        if "keypoint_confidence" in maps:
            predicted = np.concatenate(self._uncertainty["keypoint_confidence"])
            parts_idx = np.array_split(np.argsort(predicted, kind="stable"), _NUM_QUANTILES)
            used = [idx for idx in parts_idx if len(idx)]
            calibration = {
                "predicted_px": [float(predicted[idx].mean()) for idx in used],
                "observed_px": [float(truth[idx].mean()) for idx in used],
            }
        return {
            "num_corners": self._num_corners,
            "lost_share": self._num_lost / self._num_corners if self._num_corners else None,
            "displacement_px_median": float(np.median(truth)) if len(truth) else None,
            "maps": maps,
            "calibration": calibration,
        }


#: A row whose values were in several lost slots has their SNR up to rounding.
_LOST_WITHIN_DB = 0.01


class SlotGrader:
    """Mean confidence where a slot was lost and where it was received."""

    def __init__(self) -> None:
        self._lost: list[float] = []
        self._received: list[float] = []

    def add(self, decoded: DecodedImage, row_snr_db: NDArray[np.float32]) -> None:
        """Take one frame and the ``(num_slots,)`` SNR its rows of blocks had at the receiver."""
        for slot_idx, snr_db in enumerate(row_snr_db):
            band = decoded.confidence[slot_idx * SLOT_PX : (slot_idx + 1) * SLOT_PX]
            if band.size:
                is_lost = snr_db <= LOST_SLOT_SNR_DB + _LOST_WITHIN_DB
                (self._lost if is_lost else self._received).append(float(band.mean()))

    def result(self) -> dict[str, float | int | None]:
        """Return ``confidence_lost``, ``confidence_received`` (None without such slots) and counts."""
        return {
            "confidence_lost": finite_mean(self._lost),
            "confidence_received": finite_mean(self._received),
            "num_lost": len(self._lost),
            "num_received": len(self._received),
        }
