import threading

import pytest

from semcast.common.mailbox import Mailbox


def test_newest_wins_and_every_loss_is_counted():
    box = Mailbox(2, "newest")
    assert [box.put(k) for k in range(10)] == [0, 0, *[1] * 8], "each says how many gave way to it"
    assert (box.dropped, len(box)) == (8, 2)
    assert [box.get(0), box.get(0), box.get(0)] == [8, 9, None]


def test_all_keeps_order_and_makes_the_sender_wait():
    box = Mailbox(2, "all")
    received = []

    def consume():
        while (item := box.get(5)) is not None:
            received.append(item)

    assert box.put(0) == 0
    assert box.put(1) == 0
    assert box.put(2, timeout_s=0.01) is None, "full, and nobody takes"
    thread = threading.Thread(target=consume)
    thread.start()
    assert all(box.put(k, timeout_s=5) == 0 for k in range(2, 200))
    box.close()
    thread.join(60)
    assert received == list(range(200))
    assert box.dropped == 0


def test_closing_wakes_whoever_waits_and_keeps_what_is_inside():
    box = Mailbox(1, "all")
    assert box.put("last") == 0
    results = []
    thread = threading.Thread(target=lambda: results.append(box.put("too late")))
    thread.start()
    box.close()
    box.close()
    thread.join(60)
    assert results == [None]
    assert box.get() == "last"
    assert box.get() is None
    assert box.put("never") is None
    assert not Mailbox(1, "newest").closed


def test_a_getter_waits_until_something_comes():
    box = Mailbox(1, "newest")
    results = []
    thread = threading.Thread(target=lambda: results.append(box.get(5)))
    thread.start()
    box.put("here")
    thread.join(60)
    assert results == ["here"]
    assert box.get(0.01) is None


def test_shrinking_drops_the_oldest_with_the_next_item():
    box = Mailbox(4, "newest")
    for k in range(4):
        box.put(k)
    box.resize(2)
    assert box.put(4) == 3
    assert (box.dropped, box.get(0), box.get(0)) == (3, 3, 4)
    box.put(5)
    assert box.clear() == 1
    assert box.dropped == 3, "cleared is not dropped"


def test_bad_arguments_are_refused():
    with pytest.raises(ValueError, match="capacity must be at least 1, got 0"):
        Mailbox(0, "all")
    with pytest.raises(ValueError, match="capacity must be at least 1, got 0"):
        Mailbox(1, "all").resize(0)
    with pytest.raises(ValueError, match="policy must be newest or all, got 'some'"):
        Mailbox(1, "some")
