from pathlib import Path

import cv2
import numpy as np
import pytest

from semcast.common.image_order import in_order, natural_key, order_of
from semcast.common.layouts.files import images_in
from semcast.common.sequence import open_sequence


def test_names_with_signs_that_are_no_digits_of_a_number_are_sorted(tmp_path):
    names = ["a10.png", "a2.png", "a²3.png", "²1.png", "٣.png"]
    assert sorted(names, key=natural_key) == ["a2.png", "a10.png", "a²3.png", "²1.png", "٣.png"]
    for name in names:
        cv2.imwrite(str(tmp_path / name), np.zeros((24, 32, 3), np.uint8))
    assert len(open_sequence(tmp_path)) == 5


@pytest.mark.parametrize("word", ["", "frame_", "cam 0 at "])
def test_names_that_are_times_without_the_zeros_at_their_end_are_in_order_of_time(tmp_path, word):
    times_s = [1_700_000_000.0 + 0.0333337 * k for k in range(100)]
    names = [f"{word}{t_s}.jpg" if k % 7 else f"{word}{t_s:.2f}.JPG" for k, t_s in enumerate(times_s)]
    assert len({len(name) for name in names}) > 2
    for name in names:
        (tmp_path / name).touch()
    assert [path.name for path in images_in(tmp_path)] == names
    in_folder = [f"./train/{name.removesuffix('.jpg')}" for name in names]
    assert order_of(in_folder[::-1]) == list(range(99, -1, -1)), "as other files name them"


@pytest.mark.parametrize(
    "names",
    [
        ["1700000000.5000000", "1700000000.63555584", "1700000000.150000000", "1700000001.0"],
        ["1700000000.000005000", "1700000000.063555584", "1700000000.150000000"],
        ["v0.05", "v0.5", "v0.25"],  # chapters, or versions
        ["123456789.05", "123456789.5", "123456789.25", "other"],
        ["20260101.01", "20260101.02", "20260101.010"],
    ],
)
def test_whole_numbers_behind_a_point_stay_numbers(names):
    got = [path.stem for path in in_order(Path(f"{name}.png") for name in reversed(names))]
    assert got == sorted(names, key=natural_key)


def test_names_that_differ_by_leading_zeros_alone_are_in_one_order_on_all_machines():
    names = ["001.png", "01.png", "1.png", "2.png"]
    for given in (names, names[::-1], [*names[1:], names[0]]):
        assert [path.name for path in in_order(map(Path, given))] == names
