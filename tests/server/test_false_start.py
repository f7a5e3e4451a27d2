from semcast.server.false_start import FalseStart


def test_three_rising_ids_below_the_newest_show_that_it_was_wrong():
    start = FalseStart()
    assert [start.is_shown_by(k, k, 0) for k in (1, 2, 3)] == [False, False, True]


def test_one_late_frame_now_and_then_shows_nothing():
    start = FalseStart()
    for k in range(100, 200, 3):
        assert not start.is_shown_by(k - 1, k + 1, k)
        assert not start.is_shown_by(k - 1, k + 1, k)
        start.note_followed()


def test_what_a_lossless_agent_sends_again_shows_nothing():
    start = FalseStart()
    assert not any(start.is_shown_by(k, k, 10) for k in range(5, 11))


def test_a_number_from_far_ahead_excuses_no_id():
    start = FalseStart()
    assert [start.is_shown_by(k, k, 2**62) for k in (5, 6, 7)] == [False, False, True]
    assert [FalseStart().is_shown_by(5, 5, None) for _ in range(9)] == [False] * 9
