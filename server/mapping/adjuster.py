"""Adjustments of a growing map: asked for, taken into it, and what they tell of noise and shutter."""

from dataclasses import replace

from semcast.common.camera import Intrinsics
from semcast.server.geometry.weighting import OnlineNoise
from semcast.server.mapping.adjustment import apply_result, place_left_out
from semcast.server.mapping.bundle_problem import BundleResult, BundleRunner
from semcast.server.mapping.readout_watch import ReadoutWatch
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.mapping.whole_map import adjust_whole_map
from semcast.server.mapping.window import build_problem
from semcast.server.mapping.world_map import WorldMap

#: Steps of the adjustments of a start, which is far from where it ends,
_START_ITERATIONS = 15
#: and of a window, which was adjusted before but for its newest keyframe.
_ITERATIONS = 6


class Adjuster:
    """Has one adjustment under way at most.

    Args:
        camera: Pinhole.
        settings: Of the reconstruction.
        bundle: Runs the adjustments.

    Attributes:
        watch: Whether adjustments tell of a rolling shutter, or of another lens.
        noise: Of observations, fitted to what adjustments leave.
    """

    def __init__(self, camera: Intrinsics, settings: ReconstructionSettings, bundle: BundleRunner) -> None:
        self._camera = camera
        self._settings = settings
        self._bundle = bundle
        self.watch = ReadoutWatch(camera, is_wanted=settings.watches_readout(camera))
        self.begin()

    def begin(self) -> None:
        """Begin with a new map; an adjustment of the one before is not applied any more."""
        s = self._settings
        self.abandon()
        self.watch.forget_frames()
        self.noise = OnlineNoise(s.confidence, s.sigma0_px, s.beta, s.fit_noise)

    def abandon(self) -> None:
        """Free the runner before the map changes; what it was asked before does not apply any more."""
        if self._bundle.busy:
            self._bundle.take(wait=True)

    def submit(self, world: WorldMap, submap: int, *, start: bool = False) -> None:
        """Ask for the adjustment of the newest keyframes, unless one is under way.

        Args:
            world: The map.
            submap: Its current part.
            start: The part has just begun.
        """
        if self._bundle.busy:
            return
        mine = len(world.keyframes_of(submap))
        problem = build_problem(
            world,
            self._camera,
            self.noise.model,
            self._settings.window_size,
            start=start or mine <= self._settings.window_size // 2,
            iterations=_START_ITERATIONS if start else _ITERATIONS,
        )
        if problem is not None:
            motion = self.watch.motion(world, problem)
            self._bundle.submit(replace(problem, motion=motion, solver=self._settings.bundle_solver))

    def collect(self, world: WorldMap, *, wait: bool = False) -> BundleResult | None:
        """Bring a finished adjustment into the map; the result, or None where there is none."""
        result = self._bundle.take(wait=wait)
        if result is None:
            return None
        apply_result(world, result, self.noise)
        place_left_out(world, self._camera, self.noise.model, result)
        world.drift.take(result)
        self.watch.take(result)
        return result

    def adjust_whole(self, world: WorldMap) -> int:
        """Adjust all keyframes of a map that grows no more, if settings want it; how many."""
        self.watch.conclude()
        if not self._settings.final_adjustment:
            return 0
        return adjust_whole_map(world, self._camera, self.noise.model)
