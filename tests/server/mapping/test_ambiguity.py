"""A map must begin with the true structure, or wait."""

from dataclasses import replace

import numpy as np
import pytest

from semcast.common.geometry import rotation_angle_deg
from semcast.server.mapping import ambiguity
from semcast.server.mapping.ambiguity import decide
from semcast.server.mapping.depth_reversal import mirrored
from semcast.server.mapping.planar_ambiguity import twin


@pytest.mark.parametrize("seed", range(4))
def test_the_true_structure_is_found_from_either_start(seed, arc, direction_error_deg):
    truth = arc(focal_px=600.0, depth=4.0, noise_px=0.7, seed=seed)
    for start in (truth, mirrored(truth)):
        structure, _ = decide(start)
        assert structure is not None
        assert direction_error_deg(structure.T_world_cam, truth.T_world_cam) < 5.0
        assert np.corrcoef(structure.xyz[:, 2], truth.xyz[:, 2])[0, 1] > 0.9


def test_without_perspective_nothing_is_decided_before_the_last_chance(arc):
    far = arc(focal_px=40_000.0, depth=200.0, noise_px=1.0, turn_deg=3.0)
    assert decide(far)[0] is None
    assert decide(far, at_last=True)[0] is not None


def test_structures_that_turned_differently_are_two(arc, relative):
    """A relief that is too deep, some of its points on the wrong side: the cameras go the same way."""
    truth = arc(focal_px=600.0, depth=4.0, noise_px=0.7, seed=2)
    image = mirrored(truth)
    wrong = np.random.default_rng(7).random(len(truth.xyz)) < 0.6
    xyz = np.where(wrong[:, None], image.xyz, truth.xyz)
    _, structures = decide(replace(truth, T_world_cam=image.T_world_cam, xyz=xyz))
    true_turn = relative(truth.T_world_cam)[:3, :3]
    errors_deg = [rotation_angle_deg(true_turn.T @ relative(s.T_world_cam)[:3, :3]) for s in structures[:3]]
    assert errors_deg[0] < 0.5
    assert 2.0 < errors_deg[1] < 6.0
    assert errors_deg[2] > 8.0
    mixture = structures[1]
    both = decide(truth, [(replace(truth, T_world_cam=mixture.T_world_cam, xyz=mixture.xyz), 0.0)])[1]
    assert any(np.allclose(structure.T_world_cam, mixture.T_world_cam, atol=0.02) for structure in both[1:])


@pytest.mark.parametrize(("noise_px", "looks"), [(2.0, True), (0.1, False)])
def test_others_are_looked_for_beside_a_structure_that_may_be_meant(arc, monkeypatch, noise_px, looks):
    """The image of an image is another where the start was a mixture; not of one that fits nothing."""
    problem = arc(focal_px=600.0, depth=6.0, noise_px=noise_px)
    adjusted, begun = ambiguity.adjusted, []
    monkeypatch.setattr(ambiguity, "adjusted", lambda p: begun.append(p) or adjusted(p))
    monkeypatch.setattr(ambiguity, "twin", lambda p: None)
    decide(problem)
    assert (len(begun) > 5) == looks


@pytest.mark.parametrize("seed", range(3))
def test_a_flat_scene_is_seen_right_from_either_start(seed, wall, direction_error_deg):
    truth = wall(bend=0.5, noise_px=0.4, seed=seed)
    other = twin(truth)
    assert direction_error_deg(other.T_world_cam, truth.T_world_cam) > 25.0
    for start in (truth, other):
        structure, _ = decide(start)
        assert structure is not None
        assert direction_error_deg(structure.T_world_cam, truth.T_world_cam) < 5.0


def test_a_flat_scene_waits_while_both_structures_fit(wall):
    short = wall(way=(0.06, 0.02, 0.04), turn_deg=(0.3, -0.6, 0.0), noise_px=0.6)
    assert decide(short)[0] is None
    assert decide(short, at_last=True)[0] is not None


def begun_as(problem, structure):
    return replace(problem, T_world_cam=structure.T_world_cam, xyz=structure.xyz), structure.doubt


def test_doubt_counts_as_far_as_it_is_more_than_that_of_the_best_structure(wall):
    short = wall(way=(0.06, 0.02, 0.04), turn_deg=(0.3, -0.6, 0.0), noise_px=0.6)
    _, structures = decide(short)
    doubted = [replace(structure, doubt=3.0) for structure in structures]
    assert decide(short, [begun_as(short, structure) for structure in doubted])[0] is None
    doubted[0] = replace(doubted[0], doubt=0.0)
    assert decide(short, [begun_as(short, structure) for structure in doubted])[0] is not None


def test_a_structure_that_fits_a_little_better_each_time_is_believed_in_the_end(wall, direction_error_deg):
    """The same views with other noise, whose structures go on from one attempt to the next."""
    believed, carried, doubts = None, [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        truth = wall(bend=0.08, seed=0)
        noisy = replace(
            truth, xy=truth.xy + 0.5 * rng.standard_normal(truth.xy.shape), sigma_px=0 * truth.sigma_px + 0.5
        )
        assert decide(noisy)[0] is None, "no attempt is clear by itself"
        believed, structures = decide(noisy, [begun_as(noisy, structure) for structure in carried])
        doubts.append(structures[1].doubt - structures[0].doubt)
        carried = structures
        if believed is not None:
            break
    assert believed is not None
    assert len(doubts) >= 3
    assert doubts[-1] > doubts[0]
    assert direction_error_deg(believed.T_world_cam, truth.T_world_cam) < 10.0


def test_one_lucky_attempt_does_not_outweigh_the_others(wall, direction_error_deg):
    truth = wall(bend=0.5, noise_px=0.4)
    other = twin(truth)
    best, _ = decide(truth, [(truth, 5.0), (other, 0.0)], at_last=True)
    assert direction_error_deg(best.T_world_cam, truth.T_world_cam) > 15.0
    believed, structures = decide(truth, [(truth, 0.1), (other, 0.0)])
    assert direction_error_deg(believed.T_world_cam, truth.T_world_cam) < 5.0
    assert [structure.doubt for structure in structures] == sorted(
        structure.doubt for structure in structures
    )


def test_what_is_found_for_the_first_time_is_not_ahead_of_what_led_in_turn(wall, direction_error_deg):
    """Two structures that were ahead in turn have some doubt both; a third one that costs more has none."""
    truth = wall(bend=0.1, noise_px=0.4)
    _, structures = decide(truth, [(truth, 0.65)])
    assert direction_error_deg(structures[0].T_world_cam, truth.T_world_cam) < 10.0


def test_what_slid_along_edges_is_no_evidence_against_a_structure(arc):
    truth = arc(focal_px=600.0, depth=4.0)
    rng = np.random.default_rng(0)
    angle = rng.uniform(0, np.pi, len(truth.xy))
    along = np.column_stack([np.cos(angle), np.sin(angle)])
    xy = truth.xy + along * rng.normal(0, 1.5, (len(angle), 1))
    sigma_px = np.full(len(xy), np.sqrt(0.15))
    edge = 0.5 * np.log(15.0) * along
    structure = ambiguity.adjusted(replace(truth, xy=xy, sigma_px=sigma_px, edge=edge))
    assert structure.cost < 2.0 * len(xy), "what noise of this size costs"
    assert ambiguity.adjusted(replace(truth, xy=xy, sigma_px=sigma_px)).cost > 3.0 * structure.cost
