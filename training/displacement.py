"""Label of the keypoint head: how far one Lucas-Kanade step moves a point of the decoded image."""

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d

from semcast.common.codec import KLT_WINDOW_PX

MAX_DISPLACEMENT_PX = 8.0
#: Side of the window in which a pixel is judged as a corner.
_CORNER_PX = 9
_LUMA = (0.299, 0.587, 0.114)


def grey(x: Tensor) -> Tensor:
    """Return the luma ``(B, 1, H, W)`` of ``(B, 3, H, W)``."""
    weights = torch.tensor(_LUMA, device=x.device, dtype=x.dtype).view(1, 3, 1, 1)
    return (x * weights).sum(dim=1, keepdim=True)


def gradients(image: Tensor) -> tuple[Tensor, Tensor]:
    """Return x and y derivatives for each pixel of ``(B, 1, H, W)`` (Scharr, edges replicated)."""
    smooth = torch.tensor([3.0, 10.0, 3.0], device=image.device, dtype=image.dtype) / 16.0
    slope = torch.tensor([-0.5, 0.0, 0.5], device=image.device, dtype=image.dtype)
    kernel_x = torch.outer(smooth, slope)
    kernels = torch.stack((kernel_x, kernel_x.T))[:, None]
    padded = torch.nn.functional.pad(image, (1, 1, 1, 1), mode="replicate")
    both = conv2d(padded, kernels)
    return both[:, :1], both[:, 1:]


def window_mean(values: Tensor, side_px: int) -> Tensor:
    """Mean over a square window, cut at the edges, of ``(B, C, H, W)``.

    Rows, then columns: a tenth of the time of the square at once.
    """
    half = side_px // 2
    rows = avg_pool2d(values, (1, side_px), stride=1, padding=(0, half), count_include_pad=False)
    return avg_pool2d(rows, (side_px, 1), stride=1, padding=(half, 0), count_include_pad=False)


def lucas_kanade_step(template: Tensor, image: Tensor) -> tuple[Tensor, Tensor]:
    """Take one Lucas-Kanade step at every pixel, over the window of the tracker, which averages as much.

    As in the tracker, the gradients are those of the image in which the points are known. The server's points
    are corners of the decoded image: where only the original has a corner, nobody looks for one.

    Args:
        template: ``(B, 1, H, W)`` grey image in [0, 1] that holds the points.
        image: The image they are looked for in.

    Returns:
        The length of the step in px, clipped to ``MAX_DISPLACEMENT_PX``, and the corner strength of the
        template: the smaller eigenvalue of the structure tensor, mean over a small window. Both
        ``(B, 1, H, W)``.
    """
    ix, iy = gradients(template)
    it = image - template
    tensor = torch.cat((ix * ix, ix * iy, iy * iy), dim=1)
    a, b, c = window_mean(tensor, _CORNER_PX).split(1, dim=1)
    half_trace, spread = (a + c) / 2, (((a - c) / 2).square() + b.square()).sqrt()
    strength = (half_trace - spread).clamp_min(0.0)
    products = torch.cat((tensor, ix * it, iy * it), dim=1)
    a, b, c, ex, ey = window_mean(products, KLT_WINDOW_PX).split(1, dim=1)
    damping = 1e-5
    determinant = (a + damping) * (c + damping) - b * b
    dx = (b * ey - (c + damping) * ex) / determinant
    dy = (b * ex - (a + damping) * ey) / determinant
    length = (dx.square() + dy.square()).sqrt().clamp(max=MAX_DISPLACEMENT_PX)
    return length, strength
