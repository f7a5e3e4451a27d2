"""What an agent says about its camera."""

from semcast.common.messages import CameraInfo


def announced_camera(**changes):
    """Return a camera of 64x48 pixels, announced by a live agent ``a``, with some fields as given."""
    width, height = changes.get("image_wh", (64, 48))
    values = {
        "agent_id": "a",
        "agent_epoch": 1,
        "fx": 100.0,
        "fy": 100.0,
        "cx": (width - 1) / 2,
        "cy": (height - 1) / 2,
        "image_wh": (width, height),
        "nominal_rate_hz": 10.0,
        "codec": "x",
        "digest": "",
        "modulation": "16qam",
        "source_name": "s",
        "num_frames": None,
        "lossless": False,
    }
    return CameraInfo(**{**values, **changes})
