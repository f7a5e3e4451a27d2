import cv2
import numpy as np
import pytest

from semcast.common.codec import DecodedImage, confidence_from_displacement_px
from semcast.evaluation.confidence_grades import KeypointGrader, PixelGrader, SlotGrader
from semcast.evaluation.uncertainty_maps import lambda_min, pixel_label


@pytest.fixture
def original(rng):
    coarse = rng.integers(0, 256, (16, 24, 3)).astype(np.uint8)
    return cv2.resize(coarse, (192, 128), interpolation=cv2.INTER_NEAREST)


@pytest.fixture
def noisy(original, rng):
    """Noise grows from left to right."""
    sigma = np.linspace(0, 30, original.shape[1])[None, :, None]
    values = original + rng.normal(size=original.shape) * sigma
    return np.clip(values, 0, 255).astype(np.uint8)


def test_the_true_label_is_calibrated_and_orders_all_pixels(original, noisy):
    grader = PixelGrader(alpha=10.0)
    grader.add(DecodedImage(noisy, pixel_label(noisy, original, 10.0)), original)
    result = grader.result()
    assert result["ece"] < 1e-6
    assert result["maps"]["confidence"]["nause"] == pytest.approx(0, abs=0.01)
    assert result["maps"]["confidence"]["spearman_pixel"] > 0.99
    assert result["maps"]["constant"] == {
        "nause": pytest.approx(1.0),
        "spearman_pixel": None,
        "spearman_block": None,
    }


def test_an_inverted_confidence_is_worse_than_none(original, noisy):
    grader = PixelGrader(alpha=10.0)
    grader.add(DecodedImage(noisy, 1 - pixel_label(noisy, original, 10.0)), original)
    result = grader.result()
    assert result["ece"] > 0.2
    assert result["maps"]["confidence"]["nause"] > 1.2
    assert result["maps"]["confidence"]["spearman_block"] < -0.9


def test_keypoint_grade_rewards_the_map_that_knows_the_displacement(original):
    # right half moved by 2 px, left half in place
    moved = original.copy()
    moved[:, 98:] = original[:, 96:-2]
    knows = np.zeros(original.shape[:2], np.float32)
    knows[:, 96:] = 2.0
    confidence = np.full(original.shape[:2], 0.5, np.float32)
    grader = KeypointGrader()
    grader.add(DecodedImage(moved, confidence, confidence_from_displacement_px(knows)), original)
    result = grader.result()
    assert result["num_corners"] > 50
    assert result["maps"]["keypoint_confidence"]["spearman"] > 0.7
    assert result["maps"]["keypoint_confidence"]["nause"] < 0.35
    assert result["maps"]["confidence"]["spearman"] is None
    predicted, observed = (result["calibration"][k] for k in ("predicted_px", "observed_px"))
    assert predicted[0] == pytest.approx(0.0, abs=1e-6)
    assert observed[-1] == pytest.approx(2.0, abs=0.2)


def test_uncertainty_over_the_structure_is_that_of_the_localisation_bound(original, rng):
    # Confidence such that (1 - c)^2 / lambda_min is what the keypoint head says: both maps grade alike.
    moved = np.roll(original, 1, axis=1)
    told = rng.uniform(0.1, 2.0, original.shape[:2])
    share = lambda_min(moved) * told
    uncertain = np.sqrt(0.9 * share / share.max()).astype(np.float32)
    grader = KeypointGrader()
    grader.add(DecodedImage(moved, 1 - uncertain, confidence_from_displacement_px(told)), original)
    result = grader.result()
    by_head, by_bound = (result["maps"][k] for k in ("keypoint_confidence", "confidence_over_lambda_min"))
    assert by_bound == pytest.approx(by_head, abs=0.02)
    assert by_bound != pytest.approx(result["maps"]["confidence"], abs=0.02)
    assert result["displacement_px_median"] == pytest.approx(1.0, abs=0.02)
    assert result["lost_share"] < 0.1


def test_codecs_without_keypoint_head_have_no_keypoint_grade(original):
    grader = KeypointGrader()
    grader.add(DecodedImage(original, np.ones(original.shape[:2], np.float32)), original)
    flat = np.zeros_like(original)
    grader.add(DecodedImage(flat, np.ones(original.shape[:2], np.float32)), original)
    result = grader.result()
    assert "keypoint_confidence" not in result["maps"]
    assert result["calibration"] is None


def test_lost_slots_are_told_from_received_ones():
    confidence = np.full((40, 32), 0.8, np.float32)
    confidence[16:32] = 0.1
    grader = SlotGrader()
    image = np.zeros((40, 32, 3), np.uint8)
    grader.add(DecodedImage(image, confidence), np.array([6.0, -20.0, 6.0], np.float32))
    assert grader.result() == {
        "confidence_lost": pytest.approx(0.1),
        "confidence_received": pytest.approx(0.8),
        "num_lost": 1,
        "num_received": 2,
    }


def test_graders_of_nothing_are_undefined():
    assert PixelGrader(30.0).result()["ece"] is None
    assert KeypointGrader().result()["displacement_px_median"] is None
    assert SlotGrader().result()["confidence_lost"] is None
