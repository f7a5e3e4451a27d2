"""The newest images, from which tracks are followed into the next one: in its light, or as they came."""

import numpy as np
from numpy.typing import NDArray

from semcast.server.geometry.brightness import with_brightness
from semcast.server.geometry.flicker import with_row_gains
from semcast.server.geometry.grey import Grey
from semcast.server.geometry.streaks import blurred_alike
from semcast.server.geometry.wide_search import Carried, WideFeatures, has_finer, search_wide
from semcast.server.mapping.sight import Sight

Array = NDArray[np.float64]

#: Number of matches that tell how what is around most tracks was warped.
_PLENTY_OF_MATCHES = 80


class RecentImages:
    """Images by how many came since: 0 is the newest one. A copy stays as it is when images come and go.

    Args:
        num_older: Images kept beside the newest one.
    """

    def __init__(self, num_older: int) -> None:
        self._num_older = num_older
        self._greys: list[Grey] = []
        self._sights: list[Sight] = []  # the newest two
        self._bands: list[Array] = []
        self._frame_ids: list[int] = []

    def __len__(self) -> int:
        return len(self._greys)

    def __getitem__(self, back: int) -> Grey:
        """Return the image that came so many before the newest one, ``(H, W)``."""
        return self._greys[-1 - back]

    @property
    def frame_ids(self) -> list[int]:
        """Of their frames, newest first."""
        return self._frame_ids[::-1]

    # Lists are replaced and never written to: those of a copy are the same.

    def append(self, sight: Sight) -> None:
        """Take the newest image."""
        self._greys = [*self._greys[-self._num_older :], sight.grey]
        self._sights = [*self._sights[-1:], sight]
        self._bands = [*self._bands[-self._num_older :], sight.band_power]
        self._frame_ids = [*self._frame_ids[-self._num_older :], sight.frame.frame_id]

    def replace_newest(self, sight: Sight) -> None:
        """Take another version of the newest image."""
        self._greys = [*self._greys[:-1], sight.grey]
        self._bands = [*self._bands[:-1], sight.band_power]

    def drop_newest(self) -> None:
        """Forget the newest image."""
        self._greys, self._bands, self._frame_ids = self._greys[:-1], self._bands[:-1], self._frame_ids[:-1]

    def blurred_alike(self, back: int, sight: Sight) -> tuple[Grey, Grey]:
        """Return an image and that of ``sight``, each with the streaks of the other one."""
        return blurred_alike(self._greys[-1 - back], sight.grey, self._bands[-1 - back], sight.band_power)

    def bring_to_light(self, change: tuple[float, float] | None) -> None:
        """Let images be as bright as the one that comes next, if they are not.

        All of them were as bright as the newest one, so what most tracks tell of it holds for all.
        """
        if change is not None:
            self._greys = [with_brightness(grey, *change) for grey in self._greys]

    def bring_to_lamps(self, gains: Array | None) -> None:
        """Let images have the bands of light of the one that comes next."""
        if gains is not None:
            self._greys = [with_row_gains(grey, gains) for grey in self._greys]

    def search_jump(self, sight: Sight, xy: Array) -> Carried | None:
        """Where points of the newest image are in the next, by descriptors: finer ones where few match.

        Args:
            sight: The next image.
            xy: ``(N, 2)`` of the points.
        """
        grey = self._greys[-1]
        jump = search_wide(self._features_of(grey), sight.wide_features, xy)
        if jump is None or jump.num_matches >= _PLENTY_OF_MATCHES or not has_finer(grey):
            return jump
        now = WideFeatures.of(sight.grey, sight.usable_pixels, fine=True)
        fine = search_wide(WideFeatures.of(grey, fine=True), now, xy)
        return fine if fine is not None and fine.num_matches > jump.num_matches else jump

    def _features_of(self, grey: Grey) -> WideFeatures:
        """Features of an older image; where it is as it came, those found when it was the newest one do."""
        as_it_came = (sight for sight in self._sights if sight.grey is grey and sight.usable.all())
        known = next(as_it_came, None)
        return WideFeatures.of(grey) if known is None else known.wide_features
