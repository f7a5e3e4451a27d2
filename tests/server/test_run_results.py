"""What can't be written is an error, whichever of the results it is, and costs no other."""

from dataclasses import replace

import numpy as np
import pytest

from semcast.common.camera import Intrinsics
from semcast.common.run_folder import read_run
from semcast.server.export.outputs import EachFile
from semcast.server.mapping.bundle import InlineBundle
from semcast.server.mapping.reconstruction import Reconstruction
from semcast.server.mapping.settings import ReconstructionSettings
from semcast.server.run_results import results_of, write_results

CAMERA = Intrinsics(fx=50.0, fy=51.0, cx=31.5, cy=23.5, width=64, height=48)
RESULTS = ("trajectory.tum", "map.ply", "reconstruction.npz")


@pytest.fixture
def reconstruction():
    made = Reconstruction(CAMERA, ReconstructionSettings(), InlineBundle())
    yield made
    made.close()


def write(folder, reconstruction, results=None):
    results = results if results is not None else results_of(reconstruction, {0: 0})
    with EachFile() as each:
        write_results(folder, reconstruction, results, CAMERA, {0: 0}, each)


@pytest.mark.parametrize("name", RESULTS)
def test_each_result_that_can_not_be_written_is_an_error(tmp_path, reconstruction, name):
    (tmp_path / name).mkdir()
    with pytest.raises(OSError, match=f"^{name}: Is a directory$"):
        write(tmp_path, reconstruction)
    assert all((tmp_path / other).is_file() for other in RESULTS if other != name)


def test_a_reconstruction_that_makes_no_sense_is_an_error_and_costs_no_other(
    tmp_path, reconstruction, read_ply
):
    poses = {0: np.full((4, 4), np.nan)}
    results = replace(results_of(reconstruction, {0: 0}), poses=poses, part_of={0: 0})
    with pytest.raises(OSError, match=r"^reconstruction.npz: T_world_cam must be finite$"):
        write(tmp_path, reconstruction, results)
    assert len(read_ply(tmp_path / "map.ply")) == 0


def test_what_there_is_of_an_empty_map_is_written(tmp_path, reconstruction):
    write(tmp_path, reconstruction)
    assert len(read_run(tmp_path).frame_ids) == 0
