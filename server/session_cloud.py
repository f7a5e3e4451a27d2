"""The dense cloud of one session: it follows the map, and its failure is nobody else's."""

import logging
from collections.abc import Callable, Iterator
from typing import TypeVar

from semcast.common.camera import Intrinsics
from semcast.server.dense.builder import DenseBuilder, DepthRunner
from semcast.server.dense.cloud import CloudPoints, DensePatch
from semcast.server.dense.process import InlineDepth, ProcessDepth
from semcast.server.mapping.reconstruction import Reconstruction
from semcast.server.mapping.state import DecodedFrame, FrameResult, MapUpdate
from semcast.server.mapping.world_map import WorldMap
from semcast.server.settings import ServerSettings

logger = logging.getLogger(__name__)

T = TypeVar("T")


class SessionCloud:
    """Grows beside a map, where the settings want it; an error ends it and not the stream.

    Args:
        settings: Of the server; a replay leaves out nothing.
        camera: Of the decoded images.
        reconstruction: Whose map.
        on_give_up: Is told why, when the cloud will not grow any more.
    """

    def __init__(
        self,
        settings: ServerSettings,
        camera: Intrinsics,
        reconstruction: Reconstruction,
        on_give_up: Callable[[str], None],
    ) -> None:
        self._reconstruction = reconstruction
        self._on_give_up = on_give_up
        self._is_live = settings.mode == "live"
        self._builder: DenseBuilder | None = None
        if settings.dense_cloud != "none":
            runner: DepthRunner = InlineDepth()
            if settings.bundle == "process":
                runner = ProcessDepth(lossless=not self._is_live, on_give_up=on_give_up)
            self._builder = DenseBuilder(
                camera, runner, lossless=not self._is_live, at_end=settings.dense_at_end
            )

    def grow(
        self, frame: DecodedFrame, result: FrameResult, update: MapUpdate | None
    ) -> tuple[DensePatch, ...]:
        """Follow what a frame did to the map; what is new in the cloud."""

        def follow(builder: DenseBuilder) -> tuple[DensePatch, ...]:
            world = self._reconstruction.world
            if update is not None:
                _follow(builder, world, update)
            if result.is_keyframe:
                builder.add_keyframe(
                    frame.frame_id, self._reconstruction.put_right(frame.image), frame.confidence
                )
            if result.is_keyframe or self._is_live:  # a replay repeats itself at any speed
                builder.advance(world)
            return builder.take_changes()

        return self._guarded(follow, ())

    def follow(self, update: MapUpdate | None) -> None:
        """Note what the adjustment at the end of a stream has moved."""
        if update is not None:
            self._guarded(lambda builder: _follow(builder, self._reconstruction.world, update), None)

    @property
    def num_waiting(self) -> int:
        """Keyframes whose depth may still be estimated."""
        return self._guarded(lambda builder: builder.num_waiting, 0)

    def complete(self, budget_s: float | None = None) -> Iterator[tuple[DensePatch, ...]]:
        """Estimate the depth that is still missing and yield what is new.

        Args:
            budget_s: What is still missing by then is left out; None waits for all.
        """
        if self._builder is None:
            return
        try:
            yield from self._builder.finish(self._reconstruction.world, budget_s)
        except Exception as err:
            self._give_up(err)

    def points(self) -> CloudPoints | None:
        """Return the cloud as it is, None where there is none."""
        return self._guarded(lambda builder: builder.points(self._reconstruction.world), None)

    def reset(self) -> None:
        """Forget everything: the map was begun anew."""
        self._guarded(lambda builder: builder.reset(), None)

    def close(self) -> None:
        """End the process that estimates depth. Idempotent."""
        builder, self._builder = self._builder, None
        if builder is not None:
            builder.close()

    def _guarded(self, act: Callable[[DenseBuilder], T], otherwise: T) -> T:
        if self._builder is None:
            return otherwise
        try:
            return act(self._builder)
        except Exception as err:
            self._give_up(err)
            return otherwise

    def _give_up(self, err: Exception) -> None:
        logger.exception("the dense cloud no longer grows")
        self._on_give_up(f"the dense cloud no longer grows: {err}")
        self.close()


def _follow(builder: DenseBuilder, world: WorldMap, update: MapUpdate) -> None:
    builder.follow(world, update.keyframe_ids.tolist())
    builder.withdraw(update.withdrawn.tolist())
