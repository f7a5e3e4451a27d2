"""What is in a folder already: an export takes its own place again, and nobody else's."""

import pytest
from full_disk import room_for

from semcast import SemcastError
from semcast.common.errors import ConfigError
from semcast.common.run_folder import read_image_paths
from semcast.server.export.formats import export_run


@pytest.mark.parametrize("format_name", ["colmap", "nerfstudio"])
@pytest.mark.parametrize("foreign", ["images/000000.jpg", "images/mine.png", "transforms.json"])
def test_images_of_others_are_not_written_over(tmp_path, arc_run, write_arc_run, format_name, foreign):
    write_arc_run(tmp_path / "run", arc_run())
    out = tmp_path / "sequence"
    (out / "images").mkdir(parents=True)
    (out / foreign).write_bytes(b"original")
    with pytest.raises(ConfigError, match=f"images of others, there is .*{foreign}: give another folder"):
        export_run(tmp_path / "run", format_name, out)
    assert [p for p in out.rglob("*") if p.is_file()] == [out / foreign]
    assert (out / foreign).read_bytes() == b"original"


@pytest.mark.parametrize(
    ("format_name", "name"),
    [
        ("colmap", "."),
        ("tum", "trajectory.tum"),
        ("dense", "dense.ply"),
        ("ply", "summary.json"),
        ("rrd", "run.rrd"),
        ("nerfstudio", "images"),
        ("colmap", "images/colmap"),
        ("tum", "here/trajectory.tum"),
    ],
)
def test_a_run_is_not_written_over_by_an_export_of_it(tmp_path, arc_run, write_arc_run, format_name, name):
    """A cloud in metres in place of the run's own would be scaled once more by the next export."""
    run = tmp_path / "run"
    write_arc_run(run, arc_run(), "keyframes")
    (run / "here").symlink_to(run)
    before = contents(run)
    with pytest.raises(ConfigError, match="^out must be another place than the run itself and its files"):
        export_run(run, format_name, run / name)
    assert contents(run) == before


def test_a_run_may_be_exported_into_its_folder_under_other_names(tmp_path, arc_run, write_arc_run):
    write_arc_run(tmp_path / "run", arc_run(), "keyframes")
    for format_name, name in (("tum", "aligned.tum"), ("colmap", "colmap")):
        assert export_run(tmp_path / "run", format_name, tmp_path / "run" / name).files


def contents(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_exports_into_one_folder_follow_each_other(tmp_path, arc_run, write_arc_run):
    write_arc_run(tmp_path / "run", arc_run())
    out = tmp_path / "out"
    # As an export that found no room leaves it: some images, no list.
    name, image = next((p.name, p.read_bytes()) for p in read_image_paths(tmp_path / "run").values())
    (out / "images").mkdir(parents=True)
    (out / "images" / name).write_bytes(image)
    alone = {}
    for format_name in ("colmap", "nerfstudio"):
        export_run(tmp_path / "run", format_name, tmp_path / format_name)
        alone |= contents(tmp_path / format_name)
    for format_name in ("colmap", "nerfstudio", "colmap"):
        export_run(tmp_path / "run", format_name, out)
    assert contents(out) == alone


def test_an_export_leaves_the_images_of_the_other_formats_model_alone(tmp_path, arc_run, write_arc_run):
    for name in ("run", "other"):
        write_arc_run(tmp_path / name, arc_run())
    image = next(iter(read_image_paths(tmp_path / "other").values()))
    image.write_bytes(image.read_bytes() + b"differs")
    out = tmp_path / "out"
    export_run(tmp_path / "run", "nerfstudio", out)
    with pytest.raises(ConfigError, match=f"there is .*{image.name}: give another folder"):
        export_run(tmp_path / "other", "colmap", out)
    export_run(tmp_path / "other", "nerfstudio", out)
    assert (out / "images" / image.name).read_bytes() == image.read_bytes()


@pytest.mark.parametrize("format_name", ["colmap", "nerfstudio"])
def test_an_export_takes_the_place_of_an_earlier_one_with_all_its_images(
    tmp_path, arc_run, write_arc_run, format_name
):
    write_arc_run(tmp_path / "run", arc_run())
    out = tmp_path / "out"
    export_run(tmp_path / "run", format_name, out)
    (out / "images" / "mask.png").write_bytes(b"of the user")
    first, *others = sorted(read_image_paths(tmp_path / "run").values())
    for path in others[1:]:
        path.unlink()
    export_run(tmp_path / "run", format_name, out)
    assert {p.name for p in (out / "images").iterdir()} == {first.name, others[0].name, "mask.png"}


OTHERS_MODELS = {
    "colmap": (
        "sparse/0/images.txt",
        "# Image list with two lines of data per image:\n1 1 0 0 0 0 0 0 1 mine.png\n\n",
    ),
    "nerfstudio": ("transforms.json", '{"frames": [{"file_path": "images/mine.png"}]}'),
}


@pytest.mark.parametrize("images", ["images", "photographs"])
@pytest.mark.parametrize("format_name", ["colmap", "nerfstudio"])
def test_a_model_by_another_program_keeps_its_place_and_its_images(
    tmp_path, arc_run, write_arc_run, format_name, images
):
    write_arc_run(tmp_path / "run", arc_run())
    out = tmp_path / "project"
    path, text = OTHERS_MODELS[format_name]
    for name, content in {
        path: text,
        "sparse/0/points3D.txt": "",
        "points3D.ply": "",
        f"{images}/mine.png": "original",
    }.items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text(content)
    before = contents(out)
    with pytest.raises(ConfigError, match="images of others, there is .*: give another folder"):
        export_run(tmp_path / "run", format_name, out)
    assert contents(out) == before


def test_a_list_that_names_files_elsewhere_costs_none(tmp_path, arc_run, write_arc_run):
    write_arc_run(tmp_path / "run", arc_run())
    out = tmp_path / "out"
    export_run(tmp_path / "run", "colmap", out)
    (out / "notes.txt").write_text("of the user")
    names = out / "sparse/0/images.txt"
    names.write_text(names.read_text() + "99 1 0 0 0 0 0 0 1 ../notes.txt\n\n")
    export_run(tmp_path / "run", "colmap", out)
    assert (out / "notes.txt").read_text() == "of the user"


def test_an_image_that_the_other_formats_model_shows_stays(tmp_path, arc_run, write_arc_run):
    write_arc_run(tmp_path / "run", arc_run())
    out = tmp_path / "out"
    for format_name in ("colmap", "nerfstudio"):
        export_run(tmp_path / "run", format_name, out)
    before = {p.name for p in (out / "images").iterdir()}
    next(iter(read_image_paths(tmp_path / "run").values())).unlink()
    export_run(tmp_path / "run", "nerfstudio", out)
    assert {p.name for p in (out / "images").iterdir()} == before


@pytest.mark.parametrize("format_name", ["colmap", "nerfstudio"])
def test_an_export_that_finds_no_room_leaves_the_one_before(tmp_path, arc_run, write_arc_run, format_name):
    for name in ("run", "other"):
        write_arc_run(tmp_path / name, arc_run())
    for path in read_image_paths(tmp_path / "other").values():
        path.write_bytes(path.read_bytes() + b"differs")
    out = tmp_path / "out"
    export_run(tmp_path / "run", format_name, out)
    before = contents(out)
    longest = max(len(content) for content in before.values())
    with room_for(longest - 1), pytest.raises(SemcastError, match=r"can't be written: .*File too large"):
        export_run(tmp_path / "other", format_name, out)
    assert contents(out) == before
