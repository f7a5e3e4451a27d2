import numpy as np
import pytest

from semcast.evaluation.pair_cell import PairCell, PairOutcome, merge_cells
from semcast.evaluation.pose_error import PoseError


def outcome(ours, theirs, cue=(), inlier=()):
    return PairOutcome(
        errors={"robust": PoseError(*ours), "off": PoseError(*theirs)},
        cpu_ms={"robust": 2.0, "off": 1.0},
        num_matches=len(cue),
        cues={"confidence": np.array(cue, np.float32)},
        true_inlier={"epipolar": np.array(inlier, dtype=bool)},
    )


@pytest.fixture
def cell():
    cell = PairCell(["robust", "off"])
    for pair_idx in range(6):
        for seed in (0, 1):
            tdir = 2.0 + pair_idx
            cell.add(
                pair_idx,
                seed,
                outcome((1.0, tdir), (1.5, 2 * tdir), cue=[0.9, 0.2], inlier=[True, False]),
            )
    return cell


def test_errors_are_ordered_by_pair_and_seed(cell):
    errors = cell.errors("robust")
    assert errors["tdir_deg"].shape == (6, 2)
    assert errors["tdir_deg"][:, 0].tolist() == [2, 3, 4, 5, 6, 7]


def test_results_by_hand(cell):
    results = cell.results()
    assert results["robust"]["tdir_deg_mean"] == pytest.approx(4.5)
    assert results["off"]["rot_deg_median"] == 1.5
    assert results["off"]["num_pairs"] == 12
    assert results["off"]["cpu_ms"]["p50"] == 1.0


def test_auroc_and_inlier_share_count_all_matches(cell):
    assert cell.auroc_of_cues() == {"epipolar": {"confidence": 1.0}}
    assert cell.inlier_share("epipolar") == 0.5
    cell.add(9, 0, outcome((0, 0), (0, 0)))
    assert cell.inlier_share("epipolar") == 0.5


def test_comparisons_pair_the_same_pairs(cell):
    rows = cell.comparisons(["robust", "off"], ["off"], np.random.default_rng(0), block=1)
    assert [(r["mode"], r["figure"]) for r in rows] == [
        ("robust", "rot_deg_mean"),
        ("robust", "tdir_deg_mean"),
    ]
    paired = rows[1]["paired"]
    assert paired.difference == pytest.approx(-4.5)
    assert paired.ratio == pytest.approx(0.5)
    assert paired.high < 0
    assert paired.num_samples == 6


def test_a_seed_that_lacks_pairs_counts_in_results_and_in_no_comparison(cell):
    cell.add(6, 0, outcome((0, 0), (0, 0)))
    assert cell.errors("off")["tdir_deg"].shape == (7, 1)
    assert cell.results()["off"]["num_pairs"] == 13
    assert (
        cell.comparisons(["robust"], ["off"], np.random.default_rng(0), block=1)[0]["paired"].num_samples == 7
    )


def test_doubles_and_missing_methods_are_refused(cell):
    with pytest.raises(ValueError, match="before"):
        cell.add(0, 0, outcome((0, 0), (0, 0)))
    with pytest.raises(ValueError, match="missing paper"):
        PairCell(["paper"]).add(0, 0, outcome((0, 0), (0, 0)))


def test_merged_cells_hold_all_pairs(cell):
    other = PairCell(["robust", "off"])
    for seed in (0, 1):
        other.add(0, seed, outcome((0.0, 0.0), (0.0, 0.0)))
    merged = merge_cells(["robust", "off"], [cell, other])
    assert merged.results()["robust"]["num_pairs"] == 14
    assert merged.results()["robust"]["tdir_deg_mean"] == pytest.approx(4.5 * 12 / 14)


def test_an_empty_cell_is_undefined():
    empty = PairCell(["off"])
    assert empty.results()["off"]["rot_deg_mean"] is None
    assert empty.auroc_of_cues() == {}
    assert empty.inlier_share("epipolar") is None
