"""What is left to do at the end of a stream is done step by step, and gives way where it must."""

from semcast.server.conclusion import conclude


class Ended:
    """A stream of three keyframes, of which none has depth."""

    num_to_adjust, num_without_depth = 3, 3

    def conclude(self):
        return None

    def complete_cloud(self, budget_s):
        while self.num_without_depth:
            self.num_without_depth -= 1
            yield (f"patch {3 - self.num_without_depth}",)


def shown_of(session, **changes):
    shown = []
    conclude(session, lambda update, patches: shown.extend(patches), lambda text: None, **changes)
    return shown


def test_all_depth_is_estimated_at_the_end():
    assert shown_of(Ended()) == ["patch 1", "patch 2", "patch 3"]


def test_depth_is_left_for_later_where_it_must_give_way():
    session = Ended()
    assert shown_of(session, gives_way=lambda: session.num_without_depth < 2) == ["patch 1", "patch 2"]
    assert shown_of(session) == ["patch 3"]


def test_a_stop_on_the_way_leaves_the_rest_of_the_depth_out_and_it_is_told(caplog):
    caplog.set_level("INFO", logger="semcast.server.conclusion")
    session = Ended()
    assert shown_of(session, is_stopped=lambda: session.num_without_depth < 3) == ["patch 1"]
    assert "no time was left for the depth of 2 keyframes: dense.ply is without them" in caplog.text


class Adjusted(Ended):
    """One whose last adjustment changed the map; of its depths the second confirms none."""

    num_to_adjust, num_without_depth = 12, 12

    def conclude(self):
        return "update"

    def complete_cloud(self, budget_s):
        assert budget_s == 7.0
        for patches in (("near", "far"), (), ("last",)):
            self.num_without_depth -= 4
            yield patches


def test_what_changed_is_shown_and_what_is_going_on_is_told_step_by_step(monkeypatch, caplog):
    monkeypatch.setattr("semcast.server.conclusion._LOG_INTERVAL_S", 0.0)
    caplog.set_level("INFO", logger="semcast.server.conclusion")
    steps = []
    conclude(Adjusted(), lambda *shown: steps.append(shown), steps.append, 7.0)
    assert steps == [
        "last adjustment of 12 keyframes",
        ("update", ()),
        "depth 0 of 12 keyframes",
        (None, ("near", "far")),
        "depth 4 of 12 keyframes",
        "depth 8 of 12 keyframes",
        (None, ("last",)),
        "depth 12 of 12 keyframes",
        "writing results",
    ]
    assert [record.getMessage() for record in caplog.records] == [
        "last adjustment of 12 keyframes",
        "the depth of 12 keyframes is estimated now",
        *(f"depth {k} of 12 keyframes" for k in (4, 8, 12)),
    ]


class Hurried(Ended):
    """One whose time is up after the first depth."""

    def complete_cloud(self, budget_s):
        self.num_without_depth -= 1
        yield ()


def test_depth_that_is_left_out_is_told_unless_it_comes_later(caplog):
    caplog.set_level("INFO", logger="semcast.server.conclusion")
    conclude(Hurried(), lambda *shown: None, lambda text: None, gives_way=lambda: True)
    assert not caplog.records
    conclude(Hurried(), lambda *shown: None, lambda text: None, 2.0)
    assert [record.getMessage() for record in caplog.records] == [
        "no time was left for the depth of 2 keyframes: dense.ply is without them"
    ]


def test_a_short_end_is_not_logged_and_one_without_anything_to_do_is_not_told(caplog):
    caplog.set_level("INFO", logger="semcast.server.conclusion")
    told, session = [], Ended()
    session.num_to_adjust = session.num_without_depth = 10
    conclude(session, lambda *shown: None, told.append)
    assert told[:2] == ["last adjustment of 10 keyframes", "depth 0 of 10 keyframes"]
    session.num_to_adjust = 0
    told.clear()
    conclude(session, lambda *shown: None, told.append)
    assert told == ["writing results"]
    assert not caplog.records
