"""What is tried to recognise the place of a lost camera, and where it can be."""

import numpy as np
from numpy.typing import NDArray

from semcast.server.geometry.weighting import NoiseModel
from semcast.server.geometry.whereabouts import Whereabouts
from semcast.server.mapping.keyframe_images import ImagedMap
from semcast.server.mapping.relocalisation import Place, Relocaliser
from semcast.server.mapping.sight import Sight
from semcast.server.mapping.wide_recognition import WideRecogniser

Array = NDArray[np.float64]


class Recogniser:
    """Asks by corners first, then by SIFT, and believes no place that the camera can't have got to.

    Args:
        near: Knows places by corners of keyframes.
        wide: Knows them from further off.
    """

    def __init__(self, near: Relocaliser, wide: WideRecogniser) -> None:
        self._near = near
        self._wide = wide

    def find(
        self,
        sight: Sight,
        mapped: ImagedMap,
        noise: NoiseModel,
        T_world_guess: Array | None,
        whereabouts: Whereabouts | None,
    ) -> Place | None:
        """Look for the place of an image whose camera is lost.

        Args:
            sight: The image.
            mapped: The map.
            noise: Of observations.
            T_world_guess: Where its motion leads the camera, None where that is not known.
            whereabouts: Where it can be in the submap of the newest keyframe, None for anywhere.
        """
        world, images = mapped.world, mapped.images
        last = world.keyframes[-1].submap
        astray: list[Place] = []

        def is_possible(place: Place) -> bool:
            if whereabouts is None or place.submap != last or whereabouts.holds(place.T_world_cam):
                return True
            astray.append(place)
            return False

        place = self._near.find(sight, world, noise, is_possible=is_possible)
        if place is None:
            place = self._wide.find(sight, world, images, noise, T_world_guess)
        if place is not None and is_possible(place):
            return place
        if whereabouts is None or not astray:
            return None
        # The next one of a row of equal things is turned alike: that and the motion tell where the camera is.
        T_world_cam = whereabouts.turned_alike(astray[0].T_world_cam)
        place = self._wide.look(sight, world, images, noise, T_world_cam)
        return place if place is None or is_possible(place) else None
