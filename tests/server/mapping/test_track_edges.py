"""Tracks know which edge they are on."""

import numpy as np
import pytest

from semcast.server.geometry.edges import edges_at
from semcast.server.geometry.grey import to_grey
from semcast.server.mapping.sight import Sight, usable_rows
from semcast.server.mapping.state import DecodedFrame
from semcast.server.mapping.tracks import TrackTable


@pytest.mark.parametrize(("mode", "has_edges"), [("robust", True), ("off", False), ("paper", False)])
def test_a_track_has_the_edge_of_its_newest_image(mode, has_edges):
    y, x = np.mgrid[:240, :320]
    images = [np.where(x < 320 // 2 + 3 * k, 60, 180) + 4 * ((x // 8 + y // 8) % 2) for k in range(2)]
    sights = []
    for k, image in enumerate(images):
        frame = DecodedFrame(k, k * 10**8, np.repeat(image[..., None], 3, axis=2).astype(np.uint8))
        sights.append(Sight(frame, to_grey(frame.image), usable_rows(frame, 240)))
    tracks = TrackTable(mode, 150, 0)
    tracks.remember(sights[0])
    assert tracks.refill(sights[0]) > 20
    begun = tracks.edge.copy()
    tracks.follow(sights[1], tracks.xy)
    assert len(tracks.edge) == len(tracks) > 20
    assert tracks.edge.any() == begun.any() == has_edges
    if has_edges:
        assert np.array_equal(tracks.edge, edges_at(sights[1].grey, tracks.xy))
        assert not np.array_equal(tracks.edge, begun[: len(tracks)])
        assert np.array_equal(tracks.seen().edge, tracks.edge[tracks.visible])
