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
