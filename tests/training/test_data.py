import pickle

import cv2
import numpy as np
import pytest
import torch

from semcast.common.errors import SourceError
from semcast.training.data import Ahead, Crops, CropSettings, random_crop, read_images


def photo(height=80, width=100, seed=0):
    return np.random.default_rng(seed).integers(0, 256, size=(height, width, 3), dtype=np.uint8)


def crops(seed=7, rank=0):
    return Crops([photo(seed=k) for k in range(3)], CropSettings(size_px=32), 4, seed, rank)


@pytest.mark.parametrize("workers", [1, 2])
def test_the_batch_of_a_step_does_not_depend_on_the_steps_before_or_on_workers(workers):
    batches = Ahead(crops(), workers)
    for step in (0, 1, 2, 7, 8, 1):
        torch.testing.assert_close(batches.get(step), crops()[step])
    batches.close()
    torch.testing.assert_close(batches.get(3), crops()[3])
    batches.close()
    assert crops()[0].shape == (4, 3, 32, 32)
    assert not torch.equal(crops()[0], crops()[1])


def test_there_is_at_least_one_worker():
    with pytest.raises(ValueError, match="workers must be >= 1, got 0"):
        Ahead(crops(), workers=0)


def test_ranks_see_different_crops():
    assert not torch.equal(crops(rank=0)[0], crops(rank=1)[0])


def test_crops_can_go_to_another_process():
    # Where processes are not forked, as on macOS.
    torch.testing.assert_close(pickle.loads(pickle.dumps(crops()))[5], crops()[5])


def test_a_photo_smaller_than_the_crop_is_enlarged():
    crop = random_crop(photo(20, 30), CropSettings(size_px=64), np.random.default_rng(0))
    assert crop.shape == (64, 64, 3)


def test_photos_may_be_enlarged_on_purpose():
    stripes = np.tile(np.repeat(np.array([0, 255], np.uint8), 4), 16)[None, :, None] * np.ones(
        (128, 1, 3), np.uint8
    )

    def flips(scale):
        settings = CropSettings(size_px=64, scale_min=scale, scale_max=scale, share_grey=0.0)
        crop = random_crop(stripes, settings, np.random.default_rng(0))[..., 0].astype(int) > 127
        return max(np.diff(crop.astype(int), axis=axis).astype(bool).sum(axis=axis).max() for axis in (0, 1))

    assert flips(1.0) == pytest.approx(16, abs=1)
    assert flips(2.0) == pytest.approx(8, abs=1)


def test_grey_crops_have_equal_channels():
    crop = random_crop(photo(), CropSettings(size_px=32, share_grey=1.0), np.random.default_rng(0))
    np.testing.assert_array_equal(crop[..., 0], crop[..., 2])


def drawn(image, share_grey=0.0, num=600):
    settings = CropSettings(size_px=32, scale_min=1.0, scale_max=1.0, share_grey=share_grey)
    return [random_crop(image, settings, np.random.default_rng(k)) for k in range(num)]


def test_crops_are_mirrored_and_turned_alike_often():
    image = photo(32, 32)
    sides = [np.rot90(side, k).tobytes() for side in (image, image[:, ::-1]) for k in range(4)]
    seen = [sides.index(crop.tobytes()) for crop in drawn(image) if crop.tobytes() in sides]
    assert len(seen) / 600 == pytest.approx(0.7, abs=0.06), "the others have another contrast"
    assert np.bincount(seen, minlength=8).min() > 25  # of 52


def test_three_of_ten_crops_have_another_contrast_and_brightness():
    grey = [int(crop[0, 0, 0]) for crop in drawn(np.full((32, 32, 3), 100, np.uint8))]
    other = [value for value in grey if value != 100]
    assert len(other) / 600 == pytest.approx(0.3, abs=0.06)
    # (100 - 128) * contrast + 128 + brightness, 0.7 to 1.25 and -25 to 25.
    assert 68 <= min(other) < 78
    assert 123 < max(other) <= 133


def test_the_share_of_grey_crops_is_as_told():
    is_grey = [(crop == crop[..., :1]).all() for crop in drawn(photo(32, 32), share_grey=0.25)]
    assert np.mean(is_grey) == pytest.approx(0.25, abs=0.06)


def test_images_are_read_by_name_as_rgb(tmp_path):
    red = np.zeros((32, 40, 3), np.uint8)
    red[..., 2] = 255  # BGR for cv2
    cv2.imwrite(str(tmp_path / "b.png"), red)
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((32, 40, 3), np.uint8))
    (tmp_path / "notes.txt").write_text("no image")
    images = read_images(tmp_path)
    assert len(images) == 2
    assert images[1][0, 0].tolist() == [255, 0, 0]


def test_images_are_read_as_an_agent_reads_them_and_what_is_none_is_told(tmp_path, caplog):
    clear = np.zeros((32, 40, 4), np.uint8)  # black, and not to be seen: laid on white
    cv2.imwrite(str(tmp_path / "a.png"), clear)
    (tmp_path / "0.jpg").write_bytes(b"damaged")
    (image,) = read_images(tmp_path)
    assert image.min() == 255
    assert image.flags.c_contiguous, "crops of others can't be resized"
    assert "left out: " in caplog.text
    assert "0.jpg is not a readable image" in caplog.text


def test_images_too_small_to_start_from_are_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((31, 40, 3), np.uint8))
    with pytest.raises(SourceError, match="sides of at least 32 pixels, .*a.png is 40x31"):
        read_images(tmp_path)


def test_a_folder_without_images_is_an_error(tmp_path):
    with pytest.raises(SourceError, match="no readable image"):
        read_images(tmp_path)


def test_a_folder_that_is_not_there_is_named_as_that(tmp_path):
    with pytest.raises(SourceError, match="nowhere can't be read: .*No such file"):
        read_images(tmp_path / "nowhere")


def test_crop_settings_are_checked():
    with pytest.raises(ValueError, match="size_px must be a positive multiple of 16, got 100"):
        CropSettings(size_px=100)
    with pytest.raises(ValueError, match="scale_min and scale_max"):
        CropSettings(scale_min=0.9, scale_max=0.5)
    with pytest.raises(ValueError, match=r"scale_max must be in \(0, 2\] and ordered, got 0.5, 2.5"):
        CropSettings(scale_max=2.5)
    with pytest.raises(ValueError, match=r"share_grey must be in \[0, 1\], got 18"):
        CropSettings(share_grey=18.0)
