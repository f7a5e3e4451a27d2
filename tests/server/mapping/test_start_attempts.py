"""Attempts at a start are put off a number of times, and made again where there is more to go by."""

import numpy as np

from semcast.server.mapping.start_attempts import Patience, Undecided


def test_patience_ends():
    patience = Patience(2)
    assert [patience.puts_off() for _ in range(4)] == [True, True, False, False]


def test_what_was_never_undecided_is_always_tried():
    undecided = Undecided()
    undecided.note_evidence(np.array([10.0, 5.0]))
    assert all(undecided.wants(np.array([1.0, 1.0])) for _ in range(100))
    assert not undecided.is_overdue


def test_an_attempt_is_made_again_where_either_evidence_has_grown():
    undecided = Undecided()
    undecided.note_attempt(["hypothesis"])
    assert undecided.hypotheses == ["hypothesis"]
    undecided.note_evidence(np.array([10.0, 5.0]))
    wanted = [undecided.wants(np.array(px)) for px in ((11.0, 5.5), (12.0, 1.0), (1.0, 6.0))]
    assert wanted == [False, True, True]
    undecided.forget_evidence()
    assert undecided.wants(np.array([0.1, 0.1]))


def test_after_twelve_attempts_or_sixty_frames_the_best_has_to_do():
    attempts, frames = Undecided(), Undecided()
    for k in range(12):
        assert not attempts.is_overdue, k
        attempts.note_attempt([])
        attempts.note_evidence(np.array([10.0, 5.0]))
    assert attempts.is_overdue
    assert attempts.wants(np.array([1.0, 1.0]))
    frames.note_attempt([])
    frames.note_evidence(np.array([10.0, 5.0]))
    asked = [frames.wants(np.array([1.0, 1.0])) for _ in range(60)]
    assert asked == [False] * 59 + [True]
