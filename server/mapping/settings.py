"""Settings of the reconstruction."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import get_args

from semcast.common.camera import Intrinsics, ReadoutFrom, check_readout
from semcast.server.geometry.weighting import ConfidenceMode
from semcast.server.mapping.bundle_problem import Solver

#: The largest seed of a search, which evaluations keep to as well.
MAX_SEED = 2**31 - 1
#: A place gets as many chances to be recognised, however far apart frames are.
_LEAST_LOST_FRAMES = 3
#: What hides everything from a camera at rest, as a bus before a car that waits, may take so long to pass.
_HIDDEN_S = 3.0


@dataclass(frozen=True, kw_only=True)
class ReconstructionSettings:
    """How frames become a path and a map.

    Raises:
        ValueError: A value is out of range.
    """

    confidence: ConfidenceMode = field(
        default="robust",
        metadata={"help": "use of confidence: robust, paper (the paper's equations), off, or an ablation"},
    )
    seed: int = field(default=0, metadata={"help": "seed of every random search"})
    max_features: int = field(default=500, metadata={"help": "keypoints followed at most"})
    window_size: int = field(default=20, metadata={"help": "keyframes in one bundle adjustment"})
    bundle_solver: Solver = field(
        default="dense",
        metadata={
            "help": "solver of a window's bundle adjustment: dense (Schur complement, the faster one) or "
            "gtsam (its factor graph); both end in the same place"
        },
    )
    final_adjustment: bool = field(
        default=True,
        metadata={"help": "adjust all keyframes at once when a stream has ended, before results are written"},
    )
    max_landmarks: int = field(
        default=20_000, metadata={"help": "landmarks kept at most; beyond that some go at every old keyframe"}
    )
    max_keyframes: int = field(
        default=300, metadata={"help": "keyframes kept with their observations; older ones are thinned out"}
    )
    sigma0_px: float = field(
        default=0.7, metadata={"help": "noise of a fully trusted keypoint in pixels; the fit starts from it"}
    )
    beta: float = field(
        default=2.0,
        metadata={"help": "sigma^2 = sigma0^2 exp(beta (1 - c)): beta in paper mode; robust mode fits it"},
    )
    fit_noise: bool = field(
        default=True, metadata={"help": "fit sigma0 (all modes but paper) and beta (nor off) to residuals"}
    )
    min_parallax_deg: float = field(
        default=1.0, metadata={"help": "angle between rays from which a point is triangulated"}
    )
    readout_ms: float | None = field(
        default=None,
        metadata={
            "help": "time in ms a rolling shutter takes from the first row to the last, 0 for a global "
            "shutter; default: what the camera's calibration says, else it is found while the camera moves"
        },
    )
    readout_from: ReadoutFrom | None = field(
        default=None,
        metadata={
            "help": "side of the image at which the readout told by --readout-ms or the calibration begins; "
            "left or right for upright phones"
        },
    )
    lost_after_s: float = field(
        default=0.4,
        metadata={
            "help": "seconds a lost camera is searched for before a new map is begun, 3 at least if it rested"
        },
    )
    turntable: bool = field(
        default=False,
        metadata={
            "help": "the camera stands and what it looks at turns, as on a turntable: only what moves in the "
            "image is taken for the scene"
        },
    )

    def __post_init__(self) -> None:
        """Check ranges."""
        if self.bundle_solver not in get_args(Solver):
            raise ValueError(
                f"bundle_solver must be one of {', '.join(get_args(Solver))}, got {self.bundle_solver!r}"
            )
        if self.confidence not in get_args(ConfidenceMode):
            allowed = ", ".join(get_args(ConfidenceMode))
            raise ValueError(f"confidence must be one of {allowed}, got {self.confidence!r}")
        for name, low, high in (
            ("seed", 0, MAX_SEED),
            ("max_features", 50, 5000),
            ("window_size", 3, 30),
            ("max_landmarks", 500, 300_000),
            ("max_keyframes", 20, 100_000),
            ("sigma0_px", 0.05, 20.0),
            ("beta", 0.0, 8.0),
            ("min_parallax_deg", 0.1, 10.0),
            ("lost_after_s", 0.0, 600.0),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f"{name} must be in [{low}, {high}], got {value}")
        check_readout(
            0.0 if self.readout_ms is None else self.readout_ms,
            "top" if self.readout_from is None else self.readout_from,
        )

    def gives_up(self, lost_ns: Sequence[int], *, rested: bool = False) -> bool:
        """Whether the map is not in sight any more.

        Args:
            lost_ns: Source times of the frames without a pose that show enough to begin a new one with.
            rested: The camera rested before: its map is hidden, and a new one would be of what hides it.
        """
        least_s = max(self.lost_after_s, _HIDDEN_S) if rested else self.lost_after_s
        enough = len(lost_ns) >= _LEAST_LOST_FRAMES
        return enough and (lost_ns[-1] - lost_ns[0]) * 1e-9 >= least_s

    def watches_readout(self, camera: Intrinsics) -> bool:
        """Whether nobody says what readout the camera has."""
        return self.readout_ms is None and camera.readout_ms == 0.0

    def with_readout(self, camera: Intrinsics) -> Intrinsics:
        """Return a camera with the readout that is set here, else with its own."""
        return replace(
            camera,
            readout_ms=camera.readout_ms if self.readout_ms is None else self.readout_ms,
            readout_from=camera.readout_from if self.readout_from is None else self.readout_from,
        )
