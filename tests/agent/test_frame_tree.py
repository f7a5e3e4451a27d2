import numpy as np
import pytest

from semcast.agent.frame_tree import MAX_GAP_NS, FrameTree, StampedTransform, plain_name
from semcast.common.errors import SourceError
from semcast.common.geometry import exp_so3, make_transform, rotation_angle_deg

MS = 1_000_000
#: A quarter turn about z: x of the child is y of the parent.
QUARTER = exp_so3([0.0, 0.0, np.pi / 2])


def moved(x, y=0.0, z=0.0, R=None):
    return make_transform(np.eye(3) if R is None else R, (x, y, z))


def tree_of(*said):
    tree = FrameTree()
    for parent, child, time_ns, T in said:
        tree.add(StampedTransform(parent, child, time_ns, T))
    return tree


def test_a_pose_goes_down_the_tree_through_turns():
    # The body stands at (1, 0, 0), turned left; its camera sits 2 ahead of it: at (1, 2, 0) of the world.
    tree = tree_of(("world", "body", 0, moved(1.0, R=QUARTER)), ("body", "cam", None, moved(2.0)))
    np.testing.assert_allclose(tree.pose("world", "cam", 0), moved(1.0, 2.0, R=QUARTER), atol=1e-12)


def test_the_other_way_round_is_the_inverse():
    tree = tree_of(("world", "body", 0, moved(1.0, R=QUARTER)), ("body", "cam", None, moved(2.0)))
    there, back = tree.pose("world", "cam", 0), tree.pose("cam", "world", 0)
    np.testing.assert_allclose(there @ back, np.eye(4), atol=1e-12)


def test_two_branches_meet_at_their_common_frame():
    # The map hangs on the body, as some localisers have it: from the map to the camera it is -3 + 2.
    tree = tree_of(("body", "map", None, moved(3.0)), ("body", "cam", None, moved(2.0)))
    np.testing.assert_allclose(tree.pose("map", "cam", 7), moved(-1.0), atol=1e-12)


def test_between_two_times_position_goes_straight_and_rotation_evenly():
    tree = tree_of(("world", "cam", 0, moved(0.0)), ("world", "cam", 100 * MS, moved(4.0, R=QUARTER)))
    pose = tree.pose("world", "cam", 25 * MS)
    np.testing.assert_allclose(pose[:3, 3], (1.0, 0.0, 0.0), atol=1e-12)
    assert rotation_angle_deg(pose[:3, :3]) == pytest.approx(22.5)


def test_order_of_arrival_does_not_matter():
    late_first = tree_of(("world", "cam", 100 * MS, moved(4.0)), ("world", "cam", 0, moved(0.0)))
    np.testing.assert_allclose(late_first.pose("world", "cam", 50 * MS), moved(2.0), atol=1e-12)


@pytest.mark.parametrize("time_ns", [-1, 100 * MS + 1])
def test_there_is_no_pose_outside_the_times_that_are_known(time_ns):
    tree = tree_of(("world", "cam", 0, moved(0.0)), ("world", "cam", 100 * MS, moved(4.0)))
    assert tree.pose("world", "cam", time_ns) is None


@pytest.mark.parametrize(("gap_ns", "is_known"), [(MAX_GAP_NS, True), (MAX_GAP_NS + 1, False)])
def test_a_long_gap_is_not_bridged(gap_ns, is_known):
    tree = tree_of(("world", "cam", 0, moved(0.0)), ("world", "cam", gap_ns, moved(4.0)))
    assert (tree.pose("world", "cam", gap_ns // 2) is not None) == is_known
    assert tree.pose("world", "cam", gap_ns) is not None, "its ends are known all the same"


def test_a_fixed_transform_holds_at_all_times():
    tree = tree_of(("body", "cam", None, moved(2.0)))
    np.testing.assert_array_equal(tree.pose("body", "cam", -5), moved(2.0))


def test_a_transform_that_is_said_again_and_again_holds_at_all_times():
    # So static_transform_publisher of ROS 1 does, if asked to only once in many seconds.
    tree = tree_of(("body", "cam", 0, moved(2.0)), ("body", "cam", 10_000 * MS, moved(2.0)))
    for time_ns in (-5, 4_000 * MS, 20_000 * MS):
        np.testing.assert_array_equal(tree.pose("body", "cam", time_ns), moved(2.0))


def test_one_transform_alone_says_nothing_of_other_times():
    assert tree_of(("body", "cam", 0, moved(2.0))).pose("body", "cam", 1) is None


def test_a_frame_with_two_parents_is_refused_where_it_is_on_the_way():
    tree = tree_of(
        ("world", "body", None, moved(1.0)),
        ("body", "cam", None, moved(2.0)),
        ("cam", "gimbal", None, moved(0.0)),
        ("odom", "gimbal", None, moved(0.0)),
    )
    np.testing.assert_array_equal(tree.pose("world", "cam", 0), moved(3.0))
    with pytest.raises(SourceError, match="frame 'gimbal' must have one parent, got 'cam' and 'odom'"):
        tree.check_connected("world", "gimbal")


def test_frames_without_a_way_between_them_are_refused():
    tree = tree_of(("world", "body", 0, moved(0.0)), ("rig", "cam", None, moved(0.0)))
    with pytest.raises(
        SourceError, match=r"from 'cam', which hangs on 'rig', to 'world', which hangs on 'world'"
    ):
        tree.pose("world", "cam", 0)


def test_an_unknown_frame_is_refused_with_those_there_are():
    tree = tree_of(("world", "body", 0, moved(0.0)))
    with pytest.raises(SourceError, match="no transform of a frame 'cam': known are body, world"):
        tree.check_connected("world", "cam")


def test_a_ring_of_frames_is_refused():
    tree = tree_of(("a", "b", None, moved(1.0)), ("b", "a", None, moved(1.0)))
    with pytest.raises(SourceError, match="in a ring"):
        tree.pose("a", "b", 0)


def test_the_slash_of_ros_1_is_no_part_of_a_name():
    assert plain_name("/world") == plain_name("world") == "world"
