"""Which marker gives a map its metre while it grows."""

import math
from dataclasses import dataclass, field

#: Few false alarms; the family robots know best.
DEFAULT_DICTIONARY = "apriltag_36h11"


@dataclass(frozen=True, kw_only=True)
class MarkerSettings:
    """A printed square marker that keyframes may show.

    Attributes:
        side_m: Side of its black square; None: no marker is looked for.
        dictionary: Its family.
        marker_id: Its number; None for the first whose size in the map is known.

    Raises:
        ValueError: A value is out of range, or there is no such family.
    """

    side_m: float | None = field(
        default=None,
        metadata={
            "flag": "marker_m",
            "help": "look for a printed square marker whose black square has this side in metres, and "
            "publish poses in metres and in its frame too: origin in its middle, x right, y up, z out of it",
        },
    )
    dictionary: str = field(
        default=DEFAULT_DICTIONARY,
        metadata={
            "flag": "marker_dictionary",
            "help": "the marker's family, as OpenCV names them: 4x4_50, aruco_original ...",
        },
    )
    marker_id: int | None = field(
        default=None,
        metadata={"help": "number of the marker; by default the first whose size in the map is known"},
    )

    def __post_init__(self) -> None:
        if self.side_m is None:
            if self.marker_id is not None:
                raise ValueError(f"marker_id needs marker_m, got {self.marker_id} without")
            if self.dictionary != DEFAULT_DICTIONARY:
                raise ValueError(f"marker_dictionary needs marker_m, got {self.dictionary!r} without")
            return
        if not 0.0 < self.side_m < math.inf:
            raise ValueError(f"marker_m must be above 0 and finite, got {self.side_m:g}")
        from semcast.server.export.markers import dictionaries  # loads OpenCV

        if self.dictionary not in (known := dictionaries()):
            raise ValueError(f"marker_dictionary must be one of {', '.join(known)}, got {self.dictionary!r}")
