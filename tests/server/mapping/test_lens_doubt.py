"""What is said of a lens that is not the one of the calibration, and of one that is."""

import re
from dataclasses import replace

import numpy as np
import pytest
from shaken_views import CAMERA, adjusted

from semcast.server.mapping import readout_watch
from semcast.server.mapping.lens_doubt import lens_doubt
from semcast.server.mapping.readout_watch import ReadoutWatch


def doubt(focal=1.0, radial=0.0, centre_px=0.0, noise_px=0.2):
    """What is said of ``CAMERA`` by 24 views of another one."""
    camera = replace(CAMERA, fx=focal * CAMERA.fx, fy=focal * CAMERA.fy, cx=CAMERA.cx + centre_px)
    views = [adjusted(camera, noise_px, seed, radial=radial).pattern_products for seed in range(2)]
    return lens_doubt(np.concatenate(views), 1.1, CAMERA)


@pytest.mark.parametrize("noise_px", [0.1, 0.3, 1.0])
def test_a_lens_that_is_right_gives_no_doubt(noise_px):
    assert doubt(noise_px=noise_px) is None


@pytest.mark.parametrize(
    ("focal", "told"), [(1.06, "too short, by about [56] %"), (0.98, "too long, by about 2 %")]
)
def test_a_focal_length_alone_is_told_with_its_least_error(focal, told):
    assert re.fullmatch(f"the focal length seems {told} or more", doubt(focal))


def test_changes_that_do_no_harm_are_not_told():
    assert doubt(focal=1.005) is None
    assert doubt(radial=-0.009) is None, "it moves no pixel by 1.2 %, and no focal length is blamed for it"
    assert doubt(centre_px=2.0) is None
    assert doubt(focal=1.02, noise_px=3.0) is None, "it is lost in the noise"


@pytest.mark.parametrize(
    ("focal", "radial"), [(1.0, -0.02), (1.0, -0.1), (0.95, -0.1), (1.05, 0.1), (1.2, 0.0)]
)
def test_where_distortion_may_have_a_part_in_it_no_value_is_told(focal, radial):
    told = doubt(focal, radial)
    assert (
        told == "the lens seems to be another one (distortion, and perhaps focal length and principal point)"
    )


def test_a_principal_point_is_told_from_distortion():
    assert doubt(centre_px=12.0) == "the principal point seems off"
    assert doubt(focal=1.04, centre_px=12.0) == "the principal point seems off, and the focal length"


def test_views_that_say_nothing_give_no_doubt():
    assert lens_doubt(np.zeros((20, 9, 9)), 1.0, CAMERA) is None
    assert lens_doubt([], 1.0, CAMERA) is None


def said(caplog):
    return [r.getMessage() for r in caplog.records if r.name == readout_watch.__name__]


@pytest.mark.parametrize(
    ("doubts", "told_at"),
    [([None, "a", None, None], []), ([None, "a", "b", "c"], [2]), ([None, "a", None, "b"], ["end"])],
)
def test_a_doubt_is_told_once_where_the_next_look_or_none_confirms_it(doubts, told_at, monkeypatch, caplog):
    """First views alone may speak for another lens: in a bare room they did."""
    watch, came = ReadoutWatch(CAMERA, is_wanted=True), iter(doubts)
    monkeypatch.setattr(readout_watch, "lens_doubt", lambda *_: next(came))
    monkeypatch.setattr(readout_watch, "fit_readout", lambda *_: None)  # that would end the watch
    result, told = adjusted(CAMERA), []
    for look in range(-1, len(doubts)):  # the first has too few views
        ids = result.problem.keyframe_ids + 100 * look
        watch.take(replace(result, problem=replace(result.problem, keyframe_ids=ids)))
        told += [look] * len(said(caplog))
        caplog.clear()
    watch.conclude()
    watch.conclude()
    assert told + ["end"] * len(said(caplog)) == told_at


def test_a_doubt_is_told_at_once_where_no_other_look_is_to_come(monkeypatch, caplog):
    watch = ReadoutWatch(CAMERA, is_wanted=True)
    monkeypatch.setattr(readout_watch, "lens_doubt", lambda *_: "a")
    result = adjusted(CAMERA)
    watch.take(result)
    watch.take(replace(result, problem=replace(result.problem, keyframe_ids=np.arange(20, 32))))
    assert not watch.is_on, "24 views know the readout"
    assert [text[:2] for text in said(caplog)] == ["a,"]


def test_a_doubt_from_before_a_rolling_shutter_was_put_right_is_dropped(monkeypatch, caplog):
    watch = ReadoutWatch(CAMERA, is_wanted=True)
    fit, calls = readout_watch.fit_readout, iter([lambda *_: None])
    monkeypatch.setattr(readout_watch, "lens_doubt", lambda *_: "a")
    monkeypatch.setattr(readout_watch, "fit_readout", lambda *known: next(calls, fit)(*known))
    rolling = replace(CAMERA, readout_ms=25.0)
    for k in range(2):
        result = adjusted(rolling, seed=k)
        ids = result.problem.keyframe_ids + 20 * k
        watch.take(replace(result, problem=replace(result.problem, keyframe_ids=ids)))
    assert watch.take_found() is not None
    watch.conclude()
    assert said(caplog) == []
