from pathlib import Path

import cv2
import numpy as np
import pytest

from semcast.evaluation.scene_picture import PICTURE, scene_picture, side_by_side

ROOT = Path(__file__).resolve().parents[2]


def test_images_of_one_row_share_a_height_and_fill_the_width():
    wide, high = np.full((50, 100, 3), 10, np.uint8), np.full((400, 200, 3), 200, np.uint8)
    row = side_by_side([wide, high, wide], 450)
    # Shapes 2, 1/2 and 2 to 1: 450 pixels at a height of 100.
    assert row.shape == (100, 450, 3)
    assert (row[:, :200] == 10).all()
    assert (row[:, 200:250] == 200).all()
    assert (row[:, 250:] == 10).all()


@pytest.mark.slow
def test_the_picture_in_the_docs_is_the_one_that_is_drawn():
    shipped = cv2.cvtColor(cv2.imread(str(ROOT / PICTURE)), cv2.COLOR_BGR2RGB)
    drawn = scene_picture()
    assert shipped.shape == drawn.shape
    # Compressed once, and the codec's arithmetic differs a little from machine to machine.
    assert np.abs(shipped.astype(float) - drawn).mean() < 3.0
