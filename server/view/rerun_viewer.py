"""The scene in Rerun: layout, entities and the stream to a viewer or a file. The only home of ``rerun``."""

import logging
import threading
import time
from enum import Enum
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from semcast.common.camera import Intrinsics
from semcast.server.mapping.state import Marker
from semcast.server.view.patch_table import PlacedPatch
from semcast.server.view.picture import Picture, confidence_colours
from semcast.server.view.scene import Changes, PointChunk, Row
from semcast.server.view.state_text import state_text

logger = logging.getLogger(__name__)

APPLICATION_ID = "semcast"

BACKGROUND = (14, 17, 23)
PATH_COLOUR = (255, 170, 40)
TRUTH_COLOUR = (150, 160, 180)
INLIER_COLOUR = (80, 230, 120)
OTHER_COLOUR = (240, 120, 70)
MARKER_COLOUR = (90, 170, 255)

#: Where Rerun has the middle of the first pixel; ours is at 0.
PIXEL_CENTRE = 0.5
#: Entity of the dense cloud, one below it for each keyframe.
DENSE = "world/dense"
DENSE_POINT_SIZE = 1.3

#: Plot values are sent when there are those of so many frames, or after so long.
_HELD_ROWS, _HELD_S = 4, 0.3
#: Plot path to (name in the legend, colour); other paths get a colour of Rerun's choice.
SERIES = {
    "link/snr_set_db": ("SNR set", (130, 140, 160)),
    "link/snr_estimated_db": ("SNR estimated", (90, 170, 255)),
    "link/psnr_db": ("PSNR of the image", (255, 170, 40)),
    "tracking/tracked": ("tracked", (130, 140, 160)),
    "tracking/inliers": ("inliers", (80, 230, 120)),
    "error/reprojection_error_px": ("reprojection error", (255, 120, 90)),
    "drops/all": ("all", (240, 120, 70)),
    "latency/decode_ms": ("decode", (90, 170, 255)),
    "latency/track_ms": ("track", (80, 230, 120)),
    "latency/map_ms": ("map", (200, 130, 255)),
    "latency/arrival_to_pose_ms": ("arrival to pose", (255, 170, 40)),
}


class Delivery(Enum):
    """What became of the data logged so far."""

    DONE = "done"
    STALLED = "stalled"
    SEVERED = "severed"


def blueprint(has_truth: bool, has_confidence: bool) -> rrb.Blueprint:
    """Return the layout: the scene at the left, state and images at the right, plots below."""
    dark = rrb.Background(color=BACKGROUND)
    scene = rrb.Spatial3DView(
        name="Camera and map" + (" (grey: ground truth)" if has_truth else ""),
        origin="/world",
        contents=["+ $origin/**", "- /world/camera/image/keypoints/**"],
        background=dark,
        line_grid=False,
        overrides={"/world/map_colour": rrb.EntityBehavior(visible=False)},
        eye_controls=rrb.EyeControls3D(kind=rrb.Eye3DKind.Orbital, tracking_entity="/world/spectator"),
    )
    pictures: list[rrb.Spatial2DView] = [
        rrb.Spatial2DView(
            name="Received image (green: keypoints that carry the pose)",
            origin="/world/camera/image",
            background=dark,
        )
    ]
    if has_confidence:
        pictures.append(
            rrb.Spatial2DView(
                name="Confidence (turquoise: trusted, red: not)", origin="/confidence", background=dark
            )
        )
    state = rrb.TextDocumentView(name="State", origin="/state")
    plots = [
        rrb.TimeSeriesView(
            name=name,
            origin=f"/plots/{origin}",
            # At the right it would hide the newest values, at the bottom most durations.
            plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=origin != "error"),
            axis_y=rrb.ScalarAxis(zoom_lock=False),
        )
        for name, origin in (
            ("SNR and PSNR (dB)", "link"),
            ("Keypoints", "tracking"),
            ("Reprojection error (px)", "error"),
            ("Latency of the stages (ms)", "latency"),
            ("Frames dropped, by reason", "drops"),
        )
    ]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                scene,
                rrb.Vertical(state, *pictures, row_shares=[1] + [4] * len(pictures)),
                column_shares=[5, 3],
            ),
            rrb.Horizontal(*plots),
            row_shares=[7, 3],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="frame", play_state="following"),
        auto_views=False,
        auto_layout=False,
    )


class RerunStream:
    """One way out of the scene: a file or a viewer. Used from one thread.

    Args:
        recording_id: The same for all streams of one run, so a viewer that saw one knows the other.
        camera: Intrinsics of the images.
        has_truth: Whether a true path will be shown.
        has_confidence: Whether there will be confidence maps.
        file: Write to this file; None sends to a viewer.
        footer: End the file with an index of it, which programs that read parts of it want. Rerun collects it
            in memory, about 30 kB a frame.
        port: Where the viewer listens, on loopback.
    """

    def __init__(
        self,
        *,
        recording_id: str,
        camera: Intrinsics,
        has_truth: bool,
        has_confidence: bool,
        file: Path | None = None,
        footer: bool = True,
        port: int = 9876,
    ) -> None:
        self._camera = camera
        self._named: set[str] = set()
        self._held: list[Row] = []
        self._held_since_s = 0.0
        self._newest: Row | None = None
        self._stream: rr.RecordingStream | None = rr.RecordingStream(
            APPLICATION_ID, recording_id=recording_id
        )
        if file is not None:
            self._stream.save(file, write_footer=footer)
        else:
            self._stream.connect_grpc(f"rerun+http://127.0.0.1:{port}/proxy")
        self._stream.send_blueprint(blueprint(has_truth, has_confidence))
        self._stream.log("world", rr.ViewCoordinates.RDF, static=True)
        self._stream.log(
            "world/spectator",
            rr.Pinhole(
                fov_y=np.radians(60.0),
                aspect_ratio=1.5,
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=1e-6,
            ),
            static=True,
        )
        self._stream.log("state", rr.TextDocument.from_fields(media_type="text/markdown"), static=True)
        self._log_pinhole(0.3)

    def _log_pinhole(self, frustum_size: float) -> None:
        camera = self._camera
        self._open().log(
            "world/camera/image",
            rr.Pinhole(
                focal_length=[camera.fx, camera.fy],
                principal_point=[camera.cx + PIXEL_CENTRE, camera.cy + PIXEL_CENTRE],
                resolution=[camera.width, camera.height],
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=frustum_size,
                color=PATH_COLOUR,
            ),
            static=True,
        )

    def _open(self) -> rr.RecordingStream:
        if self._stream is None:
            raise ValueError("the stream is closed")
        return self._stream

    @property
    def is_holding(self) -> bool:
        """Whether plot values wait for the next ``write``."""
        return bool(self._held)

    def write(self, changes: Changes) -> None:
        """Log what changed, plot values a little later; returns before it has arrived."""
        stream = self._open()
        if self._newest is not None:  # not the time of the picture that was sent last, which may be older
            _set_time(stream, self._newest)
        if changes.cleared:
            for path in (
                "world/trajectory",
                "world/map_confidence",
                "world/map_colour",
                DENSE,
                "world/truth",
                "world/marker",
            ):
                stream.log(path, rr.Clear(recursive=True))
        if changes.frustum_size is not None and changes.frustum_size > 0:
            self._log_pinhole(changes.frustum_size)
        if changes.rows:
            self._newest = changes.rows[-1]
            _set_time(stream, self._newest)
            self._write_poses(changes.rows)
        self._plot(changes.rows)
        for idx, strips in changes.segments.items():
            stream.log(
                f"world/trajectory/{idx:04d}",
                rr.LineStrips3D(strips, colors=PATH_COLOUR, radii=rr.Radius.ui_points(2.0)),
            )
        if changes.truth is not None:
            stream.log(
                "world/truth",
                rr.LineStrips3D([changes.truth], colors=TRUTH_COLOUR, radii=rr.Radius.ui_points(1.2)),
            )
        if changes.marker is not None:
            self._write_marker(changes.marker)
        for chunk in changes.chunks:
            self._write_points(chunk)
        for patch in changes.patches:
            self._write_patch(patch)
        if changes.picture is not None:
            self._write_picture(changes.picture)

    def _write_poses(self, rows: list[Row]) -> None:
        """Send poses as columns, each at its own frame and time."""
        posed = [row for row in rows if row.T_world_cam is not None]
        if not posed:
            return
        T_world_cam = np.array([row.T_world_cam for row in posed])
        times = _time_columns(posed)
        T_world_eye = np.array([row.T_world_eye for row in posed])
        for path, T in (("world/camera", T_world_cam), ("world/spectator", T_world_eye)):
            columns = rr.Transform3D.columns(translation=T[:, :3, 3], mat3x3=T[:, :3, :3])
            self._open().send_columns(path, indexes=times, columns=columns)

    def write_held(self) -> None:
        """Log the plot values that wait."""
        self._send_held(self._open())

    def _plot(self, rows: list[Row]) -> None:
        """Send plot values when there are some: a dozen curves cost as much for one frame as for ten."""
        if rows and not self._held:
            self._held_since_s = time.monotonic()
        self._held += rows
        if len(self._held) >= _HELD_ROWS or time.monotonic() - self._held_since_s >= _HELD_S:
            self.write_held()

    def _send_held(self, stream: rr.RecordingStream) -> None:
        rows, self._held = self._held, []
        if rows:
            texts = [state_text(row.frame_id, row.state, row.scalars) for row in rows]
            columns = rr.TextDocument.columns(text=texts)
            stream.send_columns("state", indexes=_time_columns(rows), columns=columns)
        for path in sorted({path for row in rows for path in row.scalars}):
            having = [row for row in rows if path in row.scalars]
            self._name_series(stream, path)
            values = [row.scalars[path] for row in having]
            stream.send_columns(
                f"plots/{path}", indexes=_time_columns(having), columns=rr.Scalars.columns(scalars=values)
            )

    def _name_series(self, stream: rr.RecordingStream, path: str) -> None:
        if path in self._named:
            return
        self._named.add(path)
        name, colour = SERIES.get(path, (path.split("/")[-1].removesuffix("_ms").replace("_", " "), None))
        stream.log(f"plots/{path}", rr.SeriesLines(names=name, colors=colour, widths=1.8), static=True)

    def _write_points(self, chunk: PointChunk) -> None:
        radius = rr.Radius.ui_points(2.2)
        by_confidence = confidence_colours(chunk.confidence)
        for path, colours in (("map_confidence", by_confidence), ("map_colour", chunk.rgb)):
            self._open().log(
                f"world/{path}/{chunk.idx:04d}", rr.Points3D(chunk.xyz, colors=colours, radii=radius)
            )

    def _write_marker(self, marker: Marker) -> None:
        corners = marker.corners_map
        outline = [np.concatenate([corners, corners[:1]])] if len(corners) else []
        self._open().log(
            "world/marker",
            rr.LineStrips3D(
                outline,
                colors=MARKER_COLOUR,
                radii=rr.Radius.ui_points(2.0),
                labels=[marker.words] * len(outline),
                show_labels=True,
            ),
        )

    def _write_patch(self, patch: PlacedPatch) -> None:
        """Send dense points once, in their keyframe's axes; where they are goes with that."""
        path, T = f"{DENSE}/{patch.frame_id:06d}", patch.T_world_points
        if patch.points is not None:
            points = rr.Points3D(
                patch.points.xyz, colors=patch.points.rgb, radii=rr.Radius.ui_points(DENSE_POINT_SIZE)
            )
            self._open().log(path, points)
        self._open().log(path, rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))

    def _write_picture(self, picture: Picture) -> None:
        stream = self._open()
        _set_time(stream, picture)
        stream.log(
            "world/camera/image", rr.EncodedImage(contents=picture.image_jpeg, media_type="image/jpeg")
        )
        colours = np.where(picture.keypoint_inlier[:, None], INLIER_COLOUR, OTHER_COLOUR).astype(np.uint8)
        stream.log(
            "world/camera/image/keypoints",
            rr.Points2D(picture.keypoints_xy + PIXEL_CENTRE, colors=colours, radii=rr.Radius.ui_points(2.0)),
        )
        if picture.confidence_jpeg is not None:
            stream.log(
                "confidence", rr.EncodedImage(contents=picture.confidence_jpeg, media_type="image/jpeg")
            )

    def flush(self, timeout_s: float) -> Delivery:
        """Wait until all logged data went out, and say how that ended.

        A frozen viewer takes the whole timeout; a dead one fails at once.
        """
        started = time.monotonic()
        try:
            self._open().flush(timeout_sec=timeout_s)
        except RuntimeError as err:
            waited_s = time.monotonic() - started
            logger.debug("viewer stream after %.2f s: %s", waited_s, err)
            return Delivery.STALLED if waited_s >= 0.9 * timeout_s else Delivery.SEVERED
        return Delivery.DONE

    def close(self, deadline_s: float = 3.0) -> bool:
        """Finish the file or connection; False when a frozen viewer made it impossible in time.

        The SDK waits without limit for a frozen viewer, also at interpreter exit. Its last reference is
        therefore dropped on a thread that may be left behind, and its exit handler is removed then.
        """
        if self._stream is None:
            return True
        box = [self._stream]
        self._stream = None

        def drop() -> None:
            self._send_held(box[0])
            box[0].disconnect()
            box.clear()

        thread = threading.Thread(target=drop, name="semcast-viewer-close", daemon=True)
        thread.start()
        thread.join(deadline_s)
        if thread.is_alive():
            rr.unregister_shutdown()
            return False
        return True


def _set_time(stream: rr.RecordingStream, of: Row | Picture) -> None:
    """Let what is logged next be of a frame."""
    stream.set_time("frame", sequence=of.frame_id)
    stream.set_time("source_time", duration=np.timedelta64(of.t_source_ns, "ns"))


def _time_columns(rows: list[Row]) -> list[rr.TimeColumn]:
    return [
        rr.TimeColumn("frame", sequence=[row.frame_id for row in rows]),
        rr.TimeColumn("source_time", duration=np.array([row.t_source_ns for row in rows], "timedelta64[ns]")),
    ]
