"""Every export is read back by the tool it is for, or by a parser written from that tool's specification."""

import json
import os
from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest
import trimesh
from evo.tools import file_interface
from full_disk import room_for
from rows_of_runs import frame_row

from semcast import SemcastError, SourceError
from semcast.cli import main
from semcast.commands.export import FORMATS as command_formats
from semcast.common.geometry import invert_transform
from semcast.common.run_folder import read_image_paths
from semcast.server.export.colmap import write_colmap
from semcast.server.export.formats import FORMATS, export_run
from semcast.server.export.geometry import landmark_rows, reprojection_errors_px
from semcast.server.export.nerfstudio import write_nerfstudio
from semcast.server.export.poses import write_run_kitti, write_run_tum
from semcast.server.frame_rows import FrameRows


def written(tmp_path, data, write_arc_run, keep="keyframes"):
    write_arc_run(tmp_path / "run", data, keep)
    return read_image_paths(tmp_path / "run")


def read_rrd(file):
    """Return what a Rerun recording holds: (entity, column) to its rows."""
    import rerun as rr

    at = {}
    for chunk in rr.chunk.RrdReader(file).stream().to_chunks():
        rows = chunk.to_record_batch()
        for name in rows.schema.names:
            at.setdefault((str(chunk.entity_path), name), []).extend(rows.column(name).to_pylist())
    return at


def test_pycolmap_reads_the_model_and_finds_the_same_reprojection_error(tmp_path, arc_run, write_arc_run):
    data = arc_run(noise_px=0.8)
    write_colmap(tmp_path / "out", data, written(tmp_path, data, write_arc_run))
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    assert model.num_images() == len(data.keyframe_ids)
    assert model.num_points3D() == len(data.landmark_ids)
    assert model.compute_num_observations() == len(data.observed_xy)
    ours = reprojection_errors_px(data)
    assert 0.7 < ours.mean() < 1.3  # the mean of a Rayleigh distribution of 0.8 px is 1.0 px

    theirs = {}
    for image in model.images.values():
        frame_id = int(image.name.removesuffix(".jpg"))
        for point2d in image.points2D:
            point = model.points3D[point2d.point3D_id]
            projected = image.project_point(point.xyz)
            theirs[(point2d.point3D_id - 1, frame_id)] = np.linalg.norm(projected - point2d.xy)
    keys = zip(data.observed_landmark_ids.tolist(), data.observed_keyframe_ids.tolist(), strict=True)
    np.testing.assert_allclose([theirs[key] for key in keys], ours, atol=2e-5)

    means_px = {k: ours[data.observed_landmark_ids == k].mean() for k in data.landmark_ids.tolist()}
    for k, point in model.points3D.items():
        assert point.error == pytest.approx(means_px[k - 1], abs=1e-4)
        row = int(np.flatnonzero(data.landmark_ids == k - 1)[0])
        np.testing.assert_array_equal(point.color, data.rgb[row])
    # COLMAP's own recomputation keeps what we wrote.
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() == pytest.approx(
        np.mean(list(means_px.values())), abs=1e-4
    )


def test_images_that_were_not_kept_are_missed_aloud(tmp_path, arc_run, write_arc_run, caplog):
    data = arc_run()
    write_colmap(tmp_path / "whole", data, written(tmp_path, data, write_arc_run))
    assert not caplog.text
    write_colmap(tmp_path / "bare", data, {})
    count = len(data.keyframe_ids)
    assert f"{count} of {count} images were not kept by the run" in caplog.text
    assert "--save-images keyframes" in caplog.text


def test_colmap_poses_are_camera_from_world_and_its_pixels_half_a_pixel_more(
    tmp_path, arc_run, write_arc_run
):
    data = arc_run()
    write_colmap(tmp_path, data, written(tmp_path, data, write_arc_run))
    model = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    camera = model.cameras[1]
    assert camera.params.tolist() == [120, 110, 79.5, 62.0]
    T_cam_world = invert_transform(data.T_world_cam)
    for row, frame_id in enumerate(data.frame_ids.tolist()):
        if frame_id not in data.keyframe_ids:
            assert not model.exists_image(frame_id + 1)
            continue
        image = model.images[frame_id + 1]
        np.testing.assert_allclose(image.cam_from_world().matrix(), T_cam_world[row, :3], atol=1e-9)
        np.testing.assert_allclose(image.projection_center(), data.T_world_cam[row, :3, 3], atol=1e-9)
    for frame_id in data.keyframe_ids.tolist():
        picture = cv2.imread(str(tmp_path / "images" / f"{frame_id:06d}.jpg"))
        assert picture.shape == (120, 160, 3)
        assert abs(picture.mean() - 10 * frame_id) < 2


def test_pycolmap_bundle_adjustment_leaves_an_exact_export_where_it_is(tmp_path, arc_run, write_arc_run):
    data = arc_run()
    write_colmap(tmp_path, data, written(tmp_path, data, write_arc_run))
    model = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    before = {k: p.xyz.copy() for k, p in model.points3D.items()}
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    config = pycolmap.BundleAdjustmentConfig()
    for k in model.reg_image_ids():
        config.add_image(k)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    moved = max(np.linalg.norm(p.xyz - before[k]) for k, p in model.points3D.items())
    assert moved < 1e-3
    assert model.cameras[1].params == pytest.approx([120, 110, 79.5, 62.0], abs=0.05)


def test_points_seen_once_and_pairs_seen_twice_do_not_break_the_model(tmp_path, arc_run):
    data = arc_run()
    k = int(data.observed_landmark_ids[0])
    first = np.flatnonzero(data.observed_landmark_ids == k)
    kept = np.setdiff1d(np.arange(len(data.observed_xy)), first[1:])
    twice = np.concatenate([kept, kept[-1:]])
    fields = {
        name: getattr(data, name)[twice]
        for name in ("observed_landmark_ids", "observed_keyframe_ids", "observed_xy")
    }
    data = type(data)(**{**{n: getattr(data, n) for n in data.__dataclass_fields__}, **fields})
    write_colmap(tmp_path, data, {})
    model = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    assert k + 1 not in model.points3D
    assert model.compute_num_observations() == len(kept) - 1


def test_a_run_without_landmarks_gives_a_model_of_cameras(tmp_path, arc_run):
    data = arc_run(num_points=0)
    write_colmap(tmp_path, data, {})
    model = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    assert (model.num_images(), model.num_points3D()) == (len(data.keyframe_ids), 0)


def nerfstudio_pixel(content, frame, points_up):
    """Project as nerfstudio does: OpenGL camera, z backward, y up, pixel centres at half integers."""
    c2w = np.array(frame["transform_matrix"])
    local = (np.c_[points_up, np.ones(len(points_up))] @ np.linalg.inv(c2w).T)[:, :3]
    x = content["fl_x"] * local[:, 0] / -local[:, 2] + content["cx"]
    y = -content["fl_y"] * local[:, 1] / -local[:, 2] + content["cy"]
    return np.stack([x, y], axis=1)


def test_nerfstudio_poses_and_points_project_onto_the_keypoints(tmp_path, arc_run, write_arc_run, read_ply):
    data = arc_run()
    images = written(tmp_path, data, write_arc_run, keep="all")
    write_nerfstudio(tmp_path / "ns", data, images)
    content = json.loads((tmp_path / "ns" / "transforms.json").read_text())
    assert [f["file_path"] for f in content["frames"]] == [f"images/{k:06d}.jpg" for k in data.frame_ids]
    assert [content[name] for name in ("k1", "k2", "p1", "p2")] == [0.0] * 4, "its images have no distortion"
    assert all((tmp_path / "ns" / f["file_path"]).is_file() for f in content["frames"])
    ply = read_ply(tmp_path / "ns" / content["ply_file_path"])
    points_up = np.stack([ply[a] for a in "xyz"], axis=1).astype(float)
    row = {int(k): n for n, k in enumerate(data.landmark_ids)}
    checked = 0
    for frame, frame_id in zip(content["frames"], data.frame_ids.tolist(), strict=True):
        seen = data.observed_keyframe_ids == frame_id
        rows = [row[k] for k in data.observed_landmark_ids[seen].tolist()]
        if rows:
            pixels = nerfstudio_pixel(content, frame, points_up[rows])
            np.testing.assert_allclose(pixels, data.observed_xy[seen] + 0.5, atol=1e-3)
            checked += len(rows)
    assert checked == len(data.observed_xy)


def test_nerfstudio_world_has_z_up_and_applied_transform_leads_back(tmp_path, arc_run, write_arc_run):
    data = arc_run()
    write_nerfstudio(tmp_path / "ns", data, written(tmp_path, data, write_arc_run))
    content = json.loads((tmp_path / "ns" / "transforms.json").read_text())
    applied = np.array(content["applied_transform"])
    assert applied.shape == (3, 4)
    assert np.linalg.det(applied[:, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(applied[:, :3] @ (0, -1, 0), (0, 0, 1))  # up is -y in ours
    flip = np.diag([1.0, -1, -1, 1])
    poses = {int(k): T for k, T in zip(data.frame_ids, data.T_world_cam, strict=True)}
    for frame, frame_id in zip(content["frames"], data.keyframe_ids.tolist(), strict=True):
        back = np.linalg.inv(np.vstack([applied, [0, 0, 0, 1]])) @ frame["transform_matrix"] @ flip
        np.testing.assert_allclose(back, poses[frame_id], atol=1e-12)
    for key in ("camera_model", "w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"):
        assert key in content


def test_nerfstudio_without_images_says_how_to_keep_them(tmp_path, arc_run):
    with pytest.raises(SourceError, match="--save-images"):
        write_nerfstudio(tmp_path, arc_run(), {})


def test_evo_reads_the_tum_file(tmp_path, arc_run):
    data = arc_run()
    write_run_tum(tmp_path / "t.tum", data)
    traj = file_interface.read_tum_trajectory_file(str(tmp_path / "t.tum"))
    np.testing.assert_allclose(traj.timestamps, data.t_source_ns * 1e-9, atol=1e-9)
    np.testing.assert_allclose(np.array(traj.poses_se3), data.T_world_cam, atol=1e-8)


def test_tum_leaves_out_frames_whose_time_goes_back(tmp_path, arc_run):
    data = arc_run()
    times = data.t_source_ns.copy()
    times[3] = times[1]
    data = type(data)(**{**{n: getattr(data, n) for n in data.__dataclass_fields__}, "t_source_ns": times})
    write_run_tum(tmp_path / "t.tum", data)
    traj = file_interface.read_tum_trajectory_file(str(tmp_path / "t.tum"))
    np.testing.assert_allclose(
        traj.positions_xyz, np.delete(data.T_world_cam[:, :3, 3], 3, axis=0), atol=1e-8
    )


def test_evo_reads_the_kitti_file_and_the_frames_are_named_beside_it(tmp_path, arc_run):
    data = arc_run()
    files = write_run_kitti(tmp_path / "poses.txt", data)
    path = file_interface.read_kitti_poses_file(str(files[0]))
    np.testing.assert_allclose(np.array(path.poses_se3), data.T_world_cam, atol=1e-10)
    np.testing.assert_allclose(np.loadtxt(files[1]), data.t_source_ns * 1e-9)
    np.testing.assert_array_equal(np.loadtxt(files[2], dtype=int), data.frame_ids)


def test_pycolmap_reads_the_ply_map(tmp_path, arc_run, write_arc_run):
    data = arc_run()
    write_arc_run(tmp_path / "run", data)
    export_run(tmp_path / "run", "ply", tmp_path / "sub" / "map.ply")
    model = pycolmap.Reconstruction()
    model.import_PLY(tmp_path / "sub" / "map.ply")
    points = sorted((tuple(p.xyz), tuple(p.color)) for p in model.points3D.values())
    ours = sorted(
        (tuple(float(v) for v in xyz.astype(np.float32)), tuple(rgb))
        for xyz, rgb in zip(data.xyz, data.rgb, strict=True)
    )
    assert len(points) == len(ours)
    for (xyz, rgb), (our_xyz, our_rgb) in zip(points, ours, strict=True):
        assert xyz == pytest.approx(our_xyz, abs=1e-6)
        assert tuple(rgb) == tuple(our_rgb)


def test_the_servers_own_rerun_recording_is_copied(tmp_path, arc_run, write_arc_run):
    write_arc_run(tmp_path / "run", arc_run())
    (tmp_path / "run" / "run.rrd").write_bytes(b"as the server wrote it")
    copy = tmp_path / "new" / "copy.rrd"
    assert export_run(tmp_path / "run", "rrd", copy).files == [copy]
    assert copy.read_bytes() == b"as the server wrote it"
    export_run(tmp_path / "run", "rrd", tmp_path / "part.rrd", part="0")
    assert (tmp_path / "part.rrd").read_bytes() == b"as the server wrote it", "there is no other part"


def test_of_a_map_of_several_parts_the_servers_own_recording_is_no_single_one(
    tmp_path, arc_run, write_arc_run
):
    data = arc_run()
    parts = np.where(np.arange(len(data.frame_ids)) < 4, 1, 0)
    write_arc_run(tmp_path / "run", replace(data, frame_submap=parts), "all")
    (tmp_path / "run" / "run.rrd").write_bytes(b"as the server wrote it")
    for part, is_copy in (("all", True), ("0", False)):
        export_run(tmp_path / "run", "rrd", tmp_path / f"{part}.rrd", part=part)
        assert ((tmp_path / f"{part}.rrd").read_bytes() == b"as the server wrote it") == is_copy


def test_a_run_without_a_posed_frame_has_nothing_to_export(tmp_path, arc_run, write_arc_run):
    data = arc_run()
    of_frames = ("frame_ids", "t_source_ns", "T_world_cam", "frame_submap", "keyframe_ids")
    observed = ("observed_landmark_ids", "observed_keyframe_ids", "observed_xy")
    nothing = {name: getattr(data, name)[:0] for name in (*of_frames, *observed)}
    write_arc_run(tmp_path / "run", replace(data, **nothing), "all")
    with pytest.raises(SourceError, match="has no posed frame, so there is nothing to export"):
        export_run(tmp_path / "run", "tum", tmp_path / "poses.tum")


def test_without_one_a_rerun_recording_is_made_of_poses_images_and_points(tmp_path, arc_run, write_arc_run):
    data = arc_run()
    write_arc_run(tmp_path / "run", data)
    export_run(tmp_path / "run", "rrd", tmp_path / "made.rrd")
    import rerun as rr

    entities = {
        str(chunk.entity_path): 0 for chunk in rr.chunk.RrdReader(tmp_path / "made.rrd").stream().to_chunks()
    }
    assert {"/world/camera", "/world/camera/image", "/world/map_colour/0000"} <= set(entities)


def test_a_rerun_recording_is_made_of_a_run_whose_folder_has_no_name_in_text(
    tmp_path, arc_run, write_arc_run
):
    folder = tmp_path / os.fsdecode(b"run\xff")
    write_arc_run(folder, arc_run())
    export_run(folder, "rrd", tmp_path / "made.rrd")
    assert (tmp_path / "made.rrd").stat().st_size > 0
    with pytest.raises(SemcastError, match=r"made.rrd can't be written: .* surrogates not allowed"):
        export_run(folder, "rrd", folder / "made.rrd")
    assert not (folder / "made.rrd").exists()


def test_a_rerun_recording_that_is_made_is_looked_at_from_a_distance_of_the_maps_size(
    tmp_path, arc_run, write_arc_run
):
    data, sizes = arc_run(), []
    for factor in (1.0, 100.0):
        T_world_cam = data.T_world_cam.copy()
        T_world_cam[:, :3, 3] *= factor
        write_arc_run(tmp_path / "run", replace(data, T_world_cam=T_world_cam, xyz=factor * data.xyz))
        export_run(tmp_path / "run", "rrd", tmp_path / "made.rrd")
        at = read_rrd(tmp_path / "made.rrd")
        (frustum,) = at["/world/camera/image", "Pinhole:image_plane_distance"][-1]
        eye, camera = (
            np.ravel(at[path, "Transform3D:translation"][0]) for path in ("/world/spectator", "/world/camera")
        )
        sizes.append((frustum, np.linalg.norm(eye - camera)))
    np.testing.assert_allclose(sizes[1], 100.0 * np.array(sizes[0]), rtol=1e-5)


def test_landmarks_in_a_rerun_recording_that_is_made_are_seen_where_their_keypoints_are(
    tmp_path, arc_run, write_arc_run
):
    data = arc_run()
    write_arc_run(tmp_path / "run", data)
    export_run(tmp_path / "run", "rrd", tmp_path / "made.rrd")
    at = read_rrd(tmp_path / "made.rrd")
    image_from_camera = np.reshape(at["/world/camera/image", "Pinhole:image_from_camera"][-1], (3, 3)).T
    k = int(data.keyframe_ids[-1])
    seen = data.observed_keyframe_ids == k
    xyz = data.xyz[landmark_rows(data)[seen]]
    T_cam_world = invert_transform(data.T_world_cam[data.frame_ids == k][0])
    projected = (xyz @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]) @ image_from_camera.T
    keypoints = at["/world/camera/image/keypoints", "Points2D:positions"][-1]
    np.testing.assert_allclose(keypoints, projected[:, :2] / projected[:, 2:], atol=1e-3)
    np.testing.assert_allclose(keypoints, data.observed_xy[seen] + 0.5, atol=1e-3)


def test_a_rerun_recording_that_is_made_is_exact_in_time_and_has_a_line_for_each_part(
    tmp_path, arc_run, write_arc_run
):
    data = arc_run()
    times_ns = 1_764_550_000_123_456_789 + 100_000_001 * np.arange(len(data.frame_ids))
    parts = np.where(np.arange(len(data.frame_ids)) < 4, 0, 1)
    write_arc_run(tmp_path / "run", replace(data, t_source_ns=times_ns, frame_submap=parts), "all")
    export_run(tmp_path / "run", "rrd", tmp_path / "made.rrd")
    at = read_rrd(tmp_path / "made.rrd")
    for entity in ("/world/camera", "/state", "/world/camera/image"):
        assert [t.value for t in at[entity, "source_time"]] == times_ns.tolist(), entity
    lines = at["/world/trajectory/0000", "LineStrips3D:strips"][-1]
    assert [len(line) for line in lines] == [4, len(times_ns) - 4]


def test_a_rerun_recording_that_is_made_draws_no_line_through_frames_without_a_pose(
    tmp_path, arc_run, write_arc_run
):
    data = arc_run()
    write_arc_run(tmp_path / "run", data)
    posed = data.frame_ids.tolist()
    record = FrameRows(tmp_path / "run")
    for frame_id in range(posed[-1] + 1):
        record.add(frame_row(frame_id, posed=frame_id in posed))
    record.close()
    with (tmp_path / "run" / "frames.jsonl").open("a") as file:
        file.write('{"frame_id": 5, "po')
    export_run(tmp_path / "run", "rrd", tmp_path / "made.rrd")
    lines = read_rrd(tmp_path / "made.rrd")["/world/trajectory/0000", "LineStrips3D:strips"][-1]
    assert [len(line) for line in lines] == [4, len(posed) - 4]


@pytest.mark.parametrize("room", [0, 3000])
def test_a_rerun_recording_that_finds_no_room_is_an_error(tmp_path, arc_run, write_arc_run, room):
    write_arc_run(tmp_path / "run", arc_run())
    with room_for(room), pytest.raises(SemcastError, match=r"made.rrd can't be written"):
        export_run(tmp_path / "run", "rrd", tmp_path / "made.rrd")
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_an_image_that_cannot_be_read_leaves_the_rerun_recording_of_before(tmp_path, arc_run, write_arc_run):
    data = arc_run()
    write_arc_run(tmp_path / "run", data)
    last = tmp_path / "run" / "images" / f"{data.keyframe_ids[-1]:06d}.jpg"
    last.write_bytes(b"no picture")
    (tmp_path / "made.rrd").write_bytes(b"of before")
    with pytest.raises(SourceError, match=rf"{last.name} can't be read as an image"):
        export_run(tmp_path / "run", "rrd", tmp_path / "made.rrd")
    assert (tmp_path / "made.rrd").read_bytes() == b"of before"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["made.rrd", "run"]


@pytest.mark.parametrize(
    ("format_name", "opened"),
    [
        ("tum", "out"),
        ("kitti", "out"),
        ("ply", "out"),
        ("colmap", "out/sparse/0/cameras.txt"),
        ("nerfstudio", "out/transforms.json"),
    ],
)
def test_the_command_writes_each_format(tmp_path, arc_run, write_arc_run, capsys, format_name, opened):
    write_arc_run(tmp_path / "run", arc_run())
    words = ["export", str(tmp_path / "run"), "--format", format_name, "--out", str(tmp_path / "out")]
    assert main(words) == 0
    assert str(tmp_path / opened) in capsys.readouterr().out.split()
    assert (tmp_path / opened).stat().st_size > 0


def test_the_commands_list_of_formats_is_the_servers():
    assert tuple(FORMATS) == command_formats


def test_export_says_in_one_line_what_is_wrong(tmp_path, arc_run, write_arc_run, capsys):
    assert main(["export", str(tmp_path), "--format", "tum", "--out", str(tmp_path / "x")]) == 1
    assert "holds no reconstruction.npz" in capsys.readouterr().err
    write_arc_run(tmp_path / "run", arc_run())
    assert main(["export", str(tmp_path / "run"), "--format", "tum", "--out", str(tmp_path)]) == 1
    assert "is a folder" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    for format_name, below in (("tum", "x.tum"), ("tum", "x/y.tum"), ("colmap", "x"), ("nerfstudio", "x")):
        out = tmp_path / "file" / below
        words = ["export", str(tmp_path / "run"), "--format", format_name, "--out", str(out)]
        assert main(words) == 1
        why = f"{out} can't be written: {tmp_path / 'file'} is a file, not a folder"
        assert capsys.readouterr().err.splitlines()[-1] == f"semcast export: {why}"
    assert main(["export", str(tmp_path / "run"), "--format", "colmap", "--out", str(tmp_path / "file")]) == 1
    assert "is a file" in capsys.readouterr().err


def test_trimesh_reads_the_points_with_their_colours(tmp_path, arc_run, write_arc_run):
    data = arc_run()
    write_arc_run(tmp_path / "run", data)
    export_run(tmp_path / "run", "ply", tmp_path / "map.ply")
    cloud = trimesh.load(tmp_path / "map.ply")
    np.testing.assert_allclose(cloud.vertices, data.xyz, atol=1e-5)
    np.testing.assert_array_equal(np.asarray(cloud.colors)[:, :3], data.rgb)


@pytest.mark.parametrize("format_name", ["colmap", "nerfstudio", "kitti"])
def test_an_export_that_finds_no_room_leaves_no_truncated_file(tmp_path, arc_run, write_arc_run, format_name):
    write_arc_run(tmp_path / "run", arc_run())
    folder = tmp_path / "out"
    folder.mkdir()
    out = folder / "poses.txt" if format_name == "kitti" else folder
    with room_for(200), pytest.raises(SemcastError, match=r"can't be written: .*File too large"):
        export_run(tmp_path / "run", format_name, out)
    assert not [p for p in folder.rglob("*") if p.is_file()]
