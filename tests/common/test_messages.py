import dataclasses

import numpy as np
import pytest
from announced import announced_camera

from semcast.common.camera import Intrinsics
from semcast.common.codec import EncodedImage
from semcast.common.levels import Levels
from semcast.common.message_fields import FieldError, Number
from semcast.common.messages import CameraInfo, SymbolFrame
from semcast.common.phy.pilots import insert_pilots
from semcast.common.phy.qam import SHAPED_SPACING, constellation
from semcast.common.phy.slots import layout_for
from semcast.common.symbol_payload import (
    data_symbols,
    encoded_image,
    equalise_frame,
    lost_slots_of,
    pack_data_symbols,
    pack_iq,
    pack_lost,
    slots_of,
    unpack_iq,
)

HW = (40, 50)  # 3 slots of 4 blocks, padded


def frame(**changes):
    layout = layout_for(HW)
    values = {
        "agent_epoch": 1,
        "seq": 0,
        "frame_id": 0,
        "t_capture_ns": 0,
        "t_source_ns": 0,
        "codec": "x",
        "digest": "",
        "image_hw": HW,
        "modulation": "16qam",
        "num_slots": layout.num_slots,
        "uses_per_slot": layout.uses_per_slot,
        "direction": "tx",
        "payload_format": "iq16",
        "payload": b"",
    }
    return SymbolFrame(**{**values, **changes})


def encoded(symbols, modulation="16qam"):
    return EncodedImage(shape_hw=HW, symbols=symbols.astype(np.complex64), modulation=modulation)


def test_every_message_starts_with_version_and_kind():
    for cls in (CameraInfo, SymbolFrame):
        assert [f.name for f in dataclasses.fields(cls)][:2] == ["version", "kind"]


def test_camera_info_gives_the_pinhole():
    info = announced_camera(fx=1.0, fy=2.0, cx=3.0, cy=4.0, image_wh=(6, 5))
    pinhole = Intrinsics(fx=1.0, fy=2.0, cx=3.0, cy=4.0, width=6, height=5)
    assert info.intrinsics == pinhole
    rolling = dataclasses.replace(info, readout_ms=20.0, readout_from="left")
    assert rolling.intrinsics == dataclasses.replace(pinhole, readout_ms=20.0, readout_from="left")


def test_a_number_of_numpys_is_a_number_on_the_air():
    assert isinstance(Number().dump(np.float64(403.14)), float)
    for none in (True, "1", None):
        with pytest.raises(FieldError, match="must be a number"):
            Number().load(none)


def test_qam_symbols_travel_in_four_bits_and_come_back_exactly(rng):
    symbols = constellation()[rng.integers(0, 16, (3, 47 * 4))]
    payload_format, payload = pack_data_symbols(encoded(symbols))
    assert (payload_format, len(payload)) == ("qam16", 3 * 47 * 4 // 2)
    back = data_symbols(frame(payload_format=payload_format, payload=payload))
    np.testing.assert_array_equal(back, symbols)


def test_shaped_symbols_travel_in_four_bits_as_well(rng):
    symbols = np.complex64(SHAPED_SPACING) * constellation()[rng.integers(0, 16, (3, 47 * 4))]
    payload_format, payload = pack_data_symbols(encoded(symbols))
    assert (payload_format, len(payload)) == ("qam16_shaped", 3 * 47 * 4 // 2)
    back = data_symbols(frame(payload_format=payload_format, payload=payload))
    np.testing.assert_allclose(back, symbols, rtol=1e-6)


def test_symbols_off_the_16qam_grid_travel_as_iq(rng):
    symbols = constellation(bits_per_symbol=6)[rng.integers(0, 64, (3, 47 * 4))]
    payload_format, payload = pack_data_symbols(encoded(symbols))
    assert (payload_format, len(payload)) == ("iq16", 4 * 3 * 47 * 4)
    back = data_symbols(frame(payload_format=payload_format, payload=payload))
    np.testing.assert_allclose(back, symbols, rtol=1e-3)


def test_analog_symbols_travel_as_iq_even_on_the_grid(rng):
    symbols = constellation()[rng.integers(0, 16, (3, 47 * 4))]
    assert pack_data_symbols(encoded(symbols, "analog"))[0] == "iq16"


def test_symbols_of_another_grid_or_not_finite_are_refused(rng):
    with pytest.raises(ValueError, match="symbols must have shape"):
        pack_data_symbols(encoded(np.ones((2, 47 * 4))))
    bad = np.ones((3, 47 * 4), dtype=np.complex64)
    bad[1, 1] = np.nan
    with pytest.raises(ValueError, match="symbols must be finite"):
        pack_data_symbols(encoded(bad, "analog"))


def test_received_samples_keep_half_precision_and_never_overflow(rng):
    samples = (rng.normal(size=(3, 192)) + 1j * rng.normal(size=(3, 192))).astype(np.complex64)
    samples[0, 0] = 1e9 - 1e9j
    back = slots_of(frame(direction="rx", payload=pack_iq(samples)))
    assert back.shape == (3, 192)
    np.testing.assert_allclose(back[1:], samples[1:], rtol=2**-10)
    assert back[0, 0] == 64992 - 64992j


def test_a_lost_frame_is_all_zero_and_lost_slots_are_the_flagged_ones():
    lost = np.array([True, False, True])
    message = frame(direction="rx", payload_format="lost", slot_lost=pack_lost(lost))
    assert not slots_of(message).any()
    np.testing.assert_array_equal(lost_slots_of(message), lost)


def test_a_frame_says_what_the_codec_made_and_what_it_decodes(rng):
    header = {"modulation": "analog", "levels": (10, 90)}
    sent = rng.normal(size=(3, 47 * 4)).astype(np.complex64)
    made = encoded_image(frame(payload=pack_iq(sent), **header))
    np.testing.assert_allclose(made.symbols, sent, atol=1e-2)
    lost = np.array([False, True, False])
    slots = insert_pilots(made.symbols)
    equalised = equalise_frame(
        frame(direction="rx", payload=pack_iq(slots), slot_lost=pack_lost(lost), **header)
    )
    received = equalised.received
    assert not received.symbols[1].any()
    np.testing.assert_allclose(received.symbols[::2], made.symbols[::2], atol=2e-2)
    for name in ("shape_hw", "modulation", "levels", "allocation"):
        assert getattr(received, name) == getattr(made, name)
    assert received.levels == Levels(10, 90)


@pytest.mark.parametrize("direction", ["tx", "rx"])
def test_frames_too_large_to_be_received_are_refused_before_they_are_worked_on(direction):
    layout = layout_for((8192, 8192))
    packed = bytes((layout.num_slots * layout.data_per_slot + 1) // 2)
    changes = {"image_hw": (8192, 8192), "num_slots": layout.num_slots, "uses_per_slot": layout.uses_per_slot}
    if direction == "tx":
        changes |= {"payload_format": "qam16", "payload": packed}
    else:
        changes |= {"direction": "rx", "payload_format": "lost", "slot_lost": bytes(layout.num_slots // 8)}
    with pytest.raises(FieldError, match="must have at most 16777216 bytes, got 50331648") as refused:
        frame(**changes).consistent()
    assert refused.value.reason == "range"


def test_directions_are_not_mixed_up():
    with pytest.raises(ValueError, match="must be tx to hold data symbols, got rx"):
        data_symbols(frame(direction="rx"))
    with pytest.raises(ValueError, match="must be rx to hold received samples, got tx"):
        slots_of(frame())
    with pytest.raises(ValueError, match=r"must have 2304 bytes, got 3"):
        unpack_iq(b"abc", (3, 192))
