from dataclasses import replace

import numpy as np
import pytest

from semcast.agent.encoder import FrameEncoder, LinkFeedback
from semcast.agent.source import SourceFrame
from semcast.common.levels import ALL_LEVELS, Levels
from semcast.common.messages import LinkReport, SymbolFrame
from semcast.common.phy.allocation import Allocation
from semcast.common.symbol_payload import data_symbols
from semcast.common.wire import pack, unpack


def report(frame_id, snr_db, t_capture_ns=10**12, epoch=1):
    return LinkReport(
        agent_epoch=epoch,
        frame_id=frame_id,
        snr_db_estimate=snr_db,
        t_capture_ns=t_capture_ns,
        num_superseded=0,
    )


def test_the_newest_report_counts_until_the_next_one():
    feedback = LinkFeedback(1, initial_db=10.0)
    assert (feedback.snr_db(), feedback.reported_frame_id) == (10.0, -1)
    feedback.update(report(5, 3.0, t_capture_ns=1))
    feedback.update(report(4, 8.0))
    feedback.update(report(9, 20.0, epoch=2))
    assert (feedback.snr_db(), feedback.reported_frame_id) == (3.0, 5)


def test_messages_carry_the_symbols_and_are_numbered(codec):
    encoder = FrameEncoder(codec, agent_epoch=3, lossless=True)
    image = np.full((40, 50, 3), 200, np.uint8)
    messages = [
        encoder.encode(SourceFrame(frame_id, 7, 8, image, final=frame_id == 9), 5.0) for frame_id in (4, 9)
    ]
    assert [(m.seq, m.frame_id, m.final) for m in messages] == [(0, 4, False), (1, 9, True)]
    first = messages[0]
    assert (first.agent_epoch, first.t_source_ns, first.t_capture_ns) == (3, 7, 8)
    assert (first.codec, first.digest, first.image_hw) == ("tiny", "0123", (40, 50))
    assert (first.num_slots, first.uses_per_slot, first.direction) == (3, 192, "tx")
    assert (first.modulation, first.payload_format, first.lossless) == ("analog", "iq16", True)
    np.testing.assert_allclose(data_symbols(first), codec.encode(image, 5.0).symbols, atol=1e-3)
    assert codec.snrs_db == [5.0, 5.0, 5.0]
    assert len(pack(first)) > 4 * 3 * 47 * 4


def test_messages_say_what_grey_levels_were_stretched_from(codec):
    class Stretching(type(codec)):
        levels = ALL_LEVELS

        def encode(self, image, snr_db):
            return replace(super().encode(image, snr_db), levels=self.levels)

    stretching = Stretching()
    frame = SourceFrame(0, 0, 0, np.zeros((16, 16, 3), np.uint8))
    for levels, numbers in (
        (ALL_LEVELS, (0, 255)),
        (Levels(3, 40), (3, 40)),
        (Levels(0, 255, 50, 180), (0, 255, 50, 180)),
    ):
        stretching.levels = levels
        message = FrameEncoder(stretching, 3, False).encode(frame, 5.0)
        assert message.levels == numbers
        assert Levels(*unpack(pack(message), SymbolFrame).levels) == levels


def test_messages_say_what_each_block_sends(codec):
    allocation = Allocation(np.array([[2, 3, 0]], np.uint8)).code

    class Varying(type(codec)):
        def encode(self, image, snr_db):
            return replace(super().encode(image, snr_db), allocation=allocation)

    frame = SourceFrame(0, 0, 0, np.zeros((16, 48, 3), np.uint8))
    message = FrameEncoder(Varying(), 3, False).encode(frame, 5.0)
    assert unpack(pack(message), SymbolFrame).allocation == allocation


def test_symbols_that_do_not_fit_the_grid_are_refused_and_not_numbered(codec):
    encoder = FrameEncoder(codec, agent_epoch=3, lossless=False)
    good = SourceFrame(0, 0, 0, np.zeros((16, 16, 3), np.uint8))

    class Broken(type(codec)):
        def encode(self, image, snr_db):
            encoded = super().encode(image, snr_db)
            return type(encoded)(encoded.shape_hw, encoded.symbols[:, :-1], encoded.modulation)

    with pytest.raises(ValueError, match="symbols must have shape"):
        FrameEncoder(Broken(), 3, False).encode(good, 5.0)
    assert encoder.encode(good, 5.0).seq == 0
