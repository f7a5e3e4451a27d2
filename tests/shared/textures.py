"""Noise on several scales: like photographs, it has something on every level of a pyramid."""

import cv2
import numpy as np


def layered_noise(shape_hw, sigmas_px, seed):
    """``(H, W)`` float32 around 0: noise blurred by each sigma, in equal parts of unit variance."""
    rng = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(rng.standard_normal(shape_hw).astype(np.float32), None, s) for s in sigmas_px]
    return sum(layer / layer.std() for layer in layers)


def texture(shape_hw=(240, 320), sigmas_px=(2.0, 5.0, 12.0), seed=0, contrast=30):
    """``(H, W)`` uint8 grey levels around 128, to each side by ``contrast`` for each layer."""
    return np.clip(layered_noise(shape_hw, sigmas_px, seed) * contrast + 128, 0, 255).astype(np.uint8)


def shifted(image, dx, dy):
    """An image moved to the right and down by so many pixels, mirrored at its border."""
    move = np.array([[1, 0, dx], [0, 1, dy]], np.float32)
    return cv2.warpAffine(image, move, image.shape[1::-1], borderMode=cv2.BORDER_REFLECT)
