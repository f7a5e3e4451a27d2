import numpy as np
import pytest

from semcast.common.errors import SourceError
from semcast.common.geometry import exp_so3, make_transform
from semcast.common.trajectory import Trajectory, read_tum, write_tum


def test_tum_round_trip(tmp_path, rng):
    poses = np.stack([make_transform(exp_so3(rng.normal(size=3)), rng.normal(size=3)) for _ in range(4)])
    trajectory = Trajectory(np.array([0.0, 0.1, 0.25, 1e9 + 0.5]), poses)
    write_tum(tmp_path / "t.tum", trajectory)
    again = read_tum(tmp_path / "t.tum")
    np.testing.assert_allclose(again.t_s, trajectory.t_s)
    np.testing.assert_allclose(again.T_world_cam, poses, atol=1e-8)


def test_times_that_came_as_nanoseconds_are_written_to_the_nanosecond(tmp_path):
    times_ns = np.array([-1_500_000_000, 1403636579763555584, 1403636579763555999])
    trajectory = Trajectory(times_ns[:2] * 1e-9, np.tile(np.eye(4), (2, 1, 1)), times_ns[:2])
    write_tum(tmp_path / "t.tum", trajectory)
    lines = (tmp_path / "t.tum").read_text().splitlines()[1:]
    assert [line.split()[0] for line in lines] == ["-1.500000000", "1403636579.763555584"]
    assert trajectory.between(0.0, 0.0).times_ns.tolist() == times_ns[:2].tolist()


def test_path_length_adds_the_steps():
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, :3, 3] = [3, 4, 0]
    poses[2, :3, 3] = [3, 4, 2]
    assert Trajectory(np.arange(3.0), poses).path_length == pytest.approx(7.0)


@pytest.mark.parametrize(
    ("start_s", "end_s", "times_s"),
    [
        (1.0, 3.0, [1, 2, 3]),
        (1.4, 2.6, [1, 2, 3]),
        (-9.0, 99.0, [0, 1, 2, 3, 4]),
        (4.2, 5.0, [4]),
        (2.0, 2.0, [2]),
    ],
)
def test_a_span_of_time_has_the_poses_that_enclose_it(start_s, end_s, times_s):
    whole = Trajectory(np.arange(5.0), np.tile(np.eye(4), (5, 1, 1)))
    assert whole.between(start_s, end_s).t_s.tolist() == times_s


@pytest.mark.parametrize("line", ["1 2 3", "0 0 0 0 0 0 0 0", "0 a 0 0 0 0 0 1"])
def test_a_bad_line_is_named(tmp_path, line):
    (tmp_path / "t.tum").write_text(f"# head\n{line}\n")
    with pytest.raises(SourceError, match="t.tum:2 must be"):
        read_tum(tmp_path / "t.tum")


def test_a_file_that_is_no_text_is_named(tmp_path):
    (tmp_path / "t.tum").write_bytes("1 0 0 0 0 0 0 1 # Straße\n".encode("latin-1"))
    with pytest.raises(SourceError, match="t.tum can't be read: .*utf-8"):
        read_tum(tmp_path / "t.tum")


def test_times_must_increase(tmp_path):
    lines = [f"{t} 0 0 0 0 0 0 1" for t in ("1403636579.7", "1403636579.8", "1403636579.75")]
    (tmp_path / "t.tum").write_text("\n".join(["# head", *lines]))
    message = "t.tum:4: times must strictly increase, got 1403636579.75 s after 1403636579.8$"
    with pytest.raises(SourceError, match=message):
        read_tum(tmp_path / "t.tum")
