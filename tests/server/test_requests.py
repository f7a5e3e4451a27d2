import functools
import threading

import pytest
from waiting import until

from semcast.common.errors import SemcastError
from semcast.server.requests import RequestDesk


def test_requests_for_the_same_thing_are_served_once_and_in_the_order_of_the_handlers():
    desk, served = RequestDesk(), []
    for what in ("save", "reset", "save"):
        assert desk.error_of(what, 0.01).startswith(f"{what} is not done yet")
    desk.serve({what: functools.partial(served.append, what) for what in ("reset", "save")})
    assert served == ["reset", "save"]


def test_all_who_ask_for_a_thing_are_told_what_came_of_it():
    desk, answers = RequestDesk(), []
    asking = [
        threading.Thread(target=lambda what=what: answers.append((what, desk.ask(what, 60.0))))
        for what in ("save", "reset", "save")
    ]
    for thread in asking:
        thread.start()

    def all_answered():
        desk.serve({"reset": lambda: "reset done", "save": lambda: "save done"})
        return len(answers) == 3

    until(all_answered)
    assert sorted(answers) == [("reset", "reset done"), ("save", "save done"), ("save", "save done")]


def test_what_is_not_served_in_time_is_told_so_and_served_afterwards():
    desk = RequestDesk()
    with pytest.raises(SemcastError, match="^save is not done yet: the server is busy"):
        desk.ask("save", 0.01)
    assert desk.error_of("save", 0.01).startswith("save is not done yet")
    served = []
    desk.serve({"save": lambda: served.append(1)})
    assert served == [1], "it is served all the same"
    desk.serve({"save": lambda: served.append(2)})
    assert served == [1], "and once"


@pytest.mark.parametrize("error", [SemcastError("disk is full"), ValueError("disk is full")])
def test_who_asks_for_what_fails_is_told_so_and_the_rest_is_served(error):
    desk, told = RequestDesk(), []

    def ask():
        with pytest.raises(SemcastError, match="disk is full") as caught:
            desk.ask("save", 60.0)
        told.append(caught)

    def fail():
        raise error

    assert desk.error_of("map", 0.01).startswith("map is not done yet")
    asking, served = threading.Thread(target=ask), []
    asking.start()

    def save_has_failed():
        desk.serve({"save": fail, "map": lambda: served.append("map")})
        return told

    until(save_has_failed)
    asking.join(60.0)
    assert served == ["map"]


def test_what_went_wrong_is_told_in_words():
    for handle, words in (
        (lambda: "no room", "no room"),
        (lambda: "", ""),
        (lambda: 1 / 0, "division by zero"),
    ):
        desk, told = RequestDesk(), []
        asking = threading.Thread(
            target=lambda desk=desk, told=told: told.append(desk.error_of("save", 60.0))
        )
        asking.start()
        until(lambda desk=desk, handle=handle, told=told: desk.serve({"save": handle}) or told)
        asking.join(60.0)
        assert words in told[0]
        assert bool(words) == bool(told[0])


def test_a_desk_that_is_closed_refuses_what_waits_and_what_comes():
    desk, told = RequestDesk(), []
    asking = [threading.Thread(target=lambda: told.append(desk.error_of("save", 60.0))) for _ in range(8)]
    for thread in asking:
        thread.start()
    desk.close()
    desk.close()
    for thread in asking:
        thread.join(60.0)
    assert told == 8 * ["save can't be served: the server is at its end"]
    assert desk.error_of("reset", 60.0) == "reset can't be served: the server is at its end"
    served = []
    desk.serve({"save": lambda: served.append(1)})
    assert not served
