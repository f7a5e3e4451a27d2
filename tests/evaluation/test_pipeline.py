import shutil

import numpy as np
import pytest

from semcast.channel.link import Link
from semcast.channel.settings import ChannelSettings
from semcast.common.codec import LOST_SLOT_SNR_DB
from semcast.common.codecs import load_codec
from semcast.common.errors import ConfigError, SourceError
from semcast.common.image import psnr_db
from semcast.common.sequence import open_sequence
from semcast.evaluation.pipeline import (
    FrameRun,
    StreamSettings,
    open_stream,
    run_frames,
    select_frames,
)


@pytest.fixture
def sequence(room):
    return open_sequence(room)


def assert_same_frames(first, second):
    assert [f.frame_id for f in first] == [f.frame_id for f in second]
    for a, b in zip(first, second, strict=True):
        assert (a.decoded is None) == (b.decoded is None)
        if a.decoded is not None:
            np.testing.assert_array_equal(a.decoded.image, b.decoded.image)
            np.testing.assert_array_equal(a.decoded.confidence, b.decoded.confidence)


def test_frames_cross_the_link_in_order_with_their_times(sequence, phase_codec):
    frames = list(run_frames(sequence, [0, 3, 6], phase_codec, Link(ChannelSettings(snr_db=20.0), 0)))
    assert [f.frame_id for f in frames] == [0, 3, 6]
    assert [f.t_source_ns for f in frames] == [100_000_000_000, 100_300_000_000, 100_600_000_000]
    for frame in frames:
        np.testing.assert_array_equal(frame.original, sequence.image(frame.frame_id))
        assert psnr_db(frame.original, frame.decoded.image) > 18
        assert frame.snr_db_estimate == pytest.approx(20.0, abs=1.5)
        assert set(frame.stage_ms) == {"encode", "channel", "equalise", "decode"}


def test_quality_rises_with_the_snr(sequence, phase_codec):
    def quality(snr_db):
        (frame,) = run_frames(sequence, [0], phase_codec, Link(ChannelSettings(snr_db=snr_db), 0))
        return psnr_db(frame.original, frame.decoded.image)

    assert quality(0.0) < quality(8.0) < quality(20.0)


def test_without_codec_the_originals_come_with_full_confidence(sequence):
    (frame,) = run_frames(sequence, [5], None, None)
    np.testing.assert_array_equal(frame.decoded.image, sequence.image(5))
    assert frame.decoded.confidence.min() == 1.0
    assert frame.row_snr_db is None
    with pytest.raises(ValueError, match="both or neither"):
        list(run_frames(sequence, [5], None, Link(ChannelSettings(), 0)))


def test_the_encoder_hears_the_receivers_estimate(sequence, phase_codec):
    told = []
    encode = phase_codec.encode
    phase_codec.encode = lambda image, snr_db: told.append(snr_db) or encode(image, snr_db)
    link = Link(ChannelSettings(snr_db=4.0), 0)
    frames = list(run_frames(sequence, [0, 1, 2], phase_codec, link))
    assert told == [4.0, frames[0].snr_db_estimate, frames[1].snr_db_estimate]


def test_an_adaptive_codec_sounds_the_link_before_the_first_frame(sequence):
    codec, told = load_codec("jpeg-amc"), []
    encode = codec.encode
    codec.encode = lambda image, snr_db: told.append(snr_db) or encode(image, snr_db)
    frames = [
        next(run_frames(sequence, [3], codec, Link(ChannelSettings(channel="rayleigh", snr_db=10.0), seed)))
        for seed in range(6)
    ]
    assert told[::2] == [10.0] * 6, "the frame that sounds is sent for the SNR that is set"
    assert max(told[1::2]) < 9.3, "fading lets less through than a steady link of that SNR"
    assert [f.frame_id for f in frames] == [3] * 6
    assert sum(f.decoded is None for f in frames) <= 1
    told.clear()
    next(run_frames(sequence, [3], codec, Link(ChannelSettings(frame_loss=1.0), 0)))
    assert told[1] == LOST_SLOT_SNR_DB, "nothing was heard of the link"


def test_lost_frames_are_kept_as_such(sequence, phase_codec):
    link = Link(ChannelSettings(frame_loss=0.5), 3)
    frames = list(run_frames(sequence, range(20), phase_codec, link))
    lost = [f for f in frames if f.decoded is None]
    assert 3 < len(lost) < 17
    assert all(f.snr_db_estimate is None and "decode" not in f.stage_ms for f in lost)


def test_a_second_pass_reuses_the_decoded_frames(sequence, phase_codec):
    run = FrameRun(sequence, range(4), phase_codec, ChannelSettings(), seed=1)
    first, second = list(run), list(run)
    assert (phase_codec.num_encoded, phase_codec.num_decoded) == (4, 4)
    assert all(a is b for a, b in zip(first, second, strict=True))


def test_above_the_memory_budget_the_same_frames_are_made_again(sequence, phase_codec):
    settings = ChannelSettings(channel="erasure", frame_loss=0.2)
    run = FrameRun(sequence, range(6), phase_codec, settings, seed=1, cache_bytes=100_000)
    first, second = list(run), list(run)
    assert phase_codec.num_encoded == 12
    assert_same_frames(first, second)


def test_an_abandoned_pass_is_not_taken_for_a_complete_one(sequence, phase_codec):
    run = FrameRun(sequence, range(4), phase_codec, ChannelSettings(), seed=1)
    next(iter(run))
    assert len(list(run)) == 4


def test_seeds_change_the_channel_and_nothing_else(sequence, phase_codec):
    def images(seed):
        return [
            f.decoded.image for f in FrameRun(sequence, [0, 1], phase_codec, ChannelSettings(), seed=seed)
        ]

    np.testing.assert_array_equal(images(0), images(0))
    assert any((a != b).any() for a, b in zip(images(0), images(1), strict=True))


def test_start_stride_and_limit_choose_frames(room, sequence):
    settings = StreamSettings(sequence=room, start=2, stride=5, max_frames=3)
    assert select_frames(sequence, settings).ids == [2, 7, 12]
    with pytest.raises(ConfigError, match="start"):
        select_frames(sequence, StreamSettings(sequence=room, start=24))


def test_an_image_that_was_kept_when_it_was_chosen_is_not_read_again(room, sequence, monkeypatch):
    read, read_image = [], type(sequence).image

    def image(self, index, camera=None):
        read.append(index)
        return read_image(self, index, camera)

    settings, size = StreamSettings(sequence=room, max_frames=4), sequence.image(0).nbytes
    monkeypatch.setattr(type(sequence), "image", image)
    chosen = select_frames(sequence, settings, keep_bytes=3 * size)
    assert (read, list(chosen.images)) == ([0, 1, 2, 3], [0, 1, 2])
    read.clear()
    run = FrameRun(sequence, chosen.ids, None, ChannelSettings(), 0, images=chosen.images, cache_bytes=0)
    kept = [frame.original for frame in run]
    assert read == [3]
    for frame_id, original in enumerate(kept):
        np.testing.assert_array_equal(original, sequence.image(frame_id))
    assert not select_frames(sequence, settings).images


def test_frames_that_can_not_be_read_are_told_and_left_out(room, tmp_path, caplog):
    shutil.copytree(room, tmp_path / "room")
    images = sorted((tmp_path / "room" / "images").iterdir())
    for image in images[3:5]:
        image.write_bytes(image.read_bytes()[:200])
    damaged = open_sequence(tmp_path / "room")
    chosen = select_frames(damaged, StreamSettings(sequence=tmp_path / "room", max_frames=6))
    assert (chosen.ids, chosen.left_out) == ([0, 1, 2, 5], [3, 4])
    assert [
        frame.frame_id for frame in FrameRun(damaged, chosen.ids, None, ChannelSettings(), 0)
    ] == chosen.ids
    told = [record.getMessage() for record in caplog.records if "left out" in record.getMessage()]
    assert [text.split(":")[0] for text in told] == ["frame 3 is left out", "frame 4 is left out"]
    assert images[3].name in told[0]
    with pytest.raises(SourceError, match=images[4].name):
        select_frames(damaged, StreamSettings(sequence=tmp_path / "room", start=3, max_frames=2))


def test_opening_gives_the_named_codec_or_none(room, phase_codec):
    sequence, codec = open_stream(StreamSettings(sequence=room, codec="none", resize=0.5))
    assert codec is None
    assert sequence.image(0).shape == (80, 112, 3)
    assert sequence.intrinsics.width == 112
    assert open_stream(StreamSettings(sequence=room), phase_codec)[1] is phase_codec
    assert open_stream(StreamSettings(sequence=room, codec="jpeg-ldpc"))[1].name == "jpeg-ldpc"


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"snr_db": ()}, "snr_db"),
        ({"snr_db": (99.0,)}, "snr_db"),
        ({"seed": -1}, "seed must be at least 0"),
        ({"seed": 2**31}, "last of the seeds must be at most 2147483647, got 2147483648"),
        ({"seed": 2**31 - 2, "seeds": 3}, "last of the seeds must be at most 2147483647, got 2147483648"),
        ({"seeds": 0}, "seeds"),
        ({"stride": 0}, "stride"),
        ({"max_frames": 0}, "max_frames"),
        ({"resize": 1.5}, "resize"),
    ],
)
def test_settings_out_of_range_are_refused(room, values, message):
    with pytest.raises(ValueError, match=message):
        StreamSettings(sequence=room, **values)


def test_all_seeds_and_links(room):
    settings = StreamSettings(sequence=room, seed=3, seeds=2, link=ChannelSettings(channel="rayleigh"))
    assert list(settings.all_seeds) == [3, 4]
    assert settings.link_at(4.0) == ChannelSettings(channel="rayleigh", snr_db=4.0)
