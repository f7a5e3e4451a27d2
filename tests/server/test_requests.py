import functools
import threading
import time

from semcast.server.requests import RequestDesk


def test_requests_for_the_same_thing_are_served_once_and_in_the_order_of_the_handlers():
    desk, answers, served = RequestDesk(), [], []
    asking = [
        threading.Thread(target=lambda what=what: answers.append((what, desk.ask(what, 60.0))))
        for what in ("save", "reset", "save")
    ]
    for thread in asking:
        thread.start()

    def serve(what):
        served.append(what)
        return f"{what} done"

    deadline_s = time.monotonic() + 60.0
    while len(answers) < 3 and time.monotonic() < deadline_s:
        if served or len(desk._waiting) == 2:  # from when both are asked for
            desk.serve({what: functools.partial(serve, what) for what in ("reset", "save")})
    assert served[:2] == ["reset", "save"]
    assert sorted(answers) == [("reset", "reset done"), ("save", "save done"), ("save", "save done")]


def test_what_is_not_served_in_time_has_no_answer():
    desk = RequestDesk()
    assert desk.ask("save", 0.01) is None
    served = []
    desk.serve({"save": lambda: served.append(1)})
    assert served == [1], "it is served all the same"
    desk.serve({"save": lambda: served.append(2)})
    assert served == [1], "and once"
