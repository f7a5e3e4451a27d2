"""When a frame becomes a keyframe."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcast.server.mapping.refuted import on_something_large
from semcast.server.mapping.track_ids import shared_rows
from semcast.server.mapping.world_map import Keyframe

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

#: A keyframe is needed when fewer landmarks agree with the pose than this share of those right after the last
#: keyframe: the pose soon rests on too little.
_FEW_SHARE = 0.45
#: The same as a number of landmarks.
_FEW = 40
#: A keyframe is wanted early, for new landmarks in time, at this share of those landmarks.
_THINNED_SHARE = 0.75
#: And with fewer tracks in sight than this share of ``max_features``.
_SPARSE_SHARE = 0.6
#: A frame with a smaller share of its rows is damaged and shows little.
_DAMAGED_SHARE = 0.5
#: Frames between the last keyframe and a damaged one, at least.
_DAMAGED_APART = 5
#: Flow since the last keyframe, in image widths, below which the camera stands: another keyframe would bring
#: neither parallax nor new views.
_STANDING_WIDTHS = 0.004
#: Flow from which on a keyframe wanted early is worth it.
_CHANGING_WIDTHS = 0.02
#: Frames since the last keyframe after which it is, whatever the flow.
_APART = 2
#: Flow from which on the view is another one.
_MOVED_WIDTHS = 0.045


@dataclass(frozen=True)
class KeyframeCues:
    """What the keyframe rule looks at.

    Attributes:
        num_inliers: Landmarks that agree with the pose.
        num_inliers_at_keyframe: The same right after the last keyframe.
        num_visible: Tracks in sight.
        max_features: Tracks wanted.
        median_flow_px: How far tracks have moved since the last keyframe, see ``median_flow_px``.
        width_px: Of the image.
        frames_since: Frames since the last keyframe.
        usable_share: Share of image rows that arrived.
    """

    num_inliers: int
    num_inliers_at_keyframe: int
    num_visible: int
    max_features: int
    median_flow_px: float
    width_px: int
    frames_since: int
    usable_share: float


def wants_keyframe(cues: KeyframeCues, *, is_in_outage: bool = False) -> bool:
    """Decide on a keyframe: the view has changed, or landmarks are running out.

    A frame of which much is missing becomes one only in need. In an outage landmarks run out because the
    image is bad, and new ones would be no better: there the view must be another one, and the pose be sure.
    """
    if is_in_outage and (cues.num_inliers < _FEW or cues.median_flow_px <= _MOVED_WIDTHS * cues.width_px):
        return False
    few = cues.num_inliers < max(_FEW_SHARE * cues.num_inliers_at_keyframe, _FEW)
    if cues.usable_share < _DAMAGED_SHARE:
        return few and cues.frames_since >= _DAMAGED_APART
    if cues.median_flow_px < _STANDING_WIDTHS * cues.width_px:
        return False
    thinned = cues.num_inliers < _THINNED_SHARE * cues.num_inliers_at_keyframe
    sparse = cues.num_visible < _SPARSE_SHARE * cues.max_features
    moved = cues.median_flow_px > _MOVED_WIDTHS * cues.width_px
    changing = cues.frames_since >= _APART or cues.median_flow_px > _CHANGING_WIDTHS * cues.width_px
    return few or moved or ((thinned or sparse) and changing)


def median_flow_px(reference: Keyframe, ids: Ids, xy: Array) -> float:
    """How far tracks have moved since a keyframe, without those on something large that moves by itself.

    Args:
        reference: The keyframe.
        ids: ``(N,)`` tracks in sight, ascending.
        xy: ``(N, 2)`` where.

    Returns:
        Median in pixels; infinite where the keyframe saw none of the tracks.
    """
    row, row_k = shared_rows(ids, reference.ids)
    at_rest = ~np.isin(ids[row], on_something_large(reference))
    flow_px = np.linalg.norm(xy[row[at_rest]] - reference.xy[row_k[at_rest]], axis=1)
    return float(np.median(flow_px)) if len(flow_px) else float("inf")
