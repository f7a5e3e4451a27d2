"""What a viewer has to be sent of dense points: they, or only where they are now."""

import numpy as np

from semcast.common.geometry import exp_se3
from semcast.server.dense.cloud import DensePatch
from semcast.server.view.patch_table import PatchTable
from semcast.server.view.scene import Cursor, Scene


def patch(frame_id, num=3, scale=1.0):
    return DensePatch(
        frame_id, np.ones((num, 3), np.float32), np.zeros((num, 3), np.uint8), np.ones(num, np.float32), scale
    )


def test_points_are_sent_once_and_moved_after():
    table, seen = PatchTable(), {}
    first = patch(4)
    table.add(first)
    assert table.changes_since(seen) == [], "nobody knows yet where they are"
    table.place({4: np.eye(4)}, [5, 4])
    (change,) = table.changes_since(seen)
    assert change.points is first
    assert table.changes_since(seen) == []
    table.place({4: np.eye(4)}, [4])
    assert table.changes_since(seen) == [], "it has not moved"
    T = exp_se3(np.full(6, 0.1))
    table.place({4: T}, [4])
    (change,) = table.changes_since(seen)
    assert change.points is None
    np.testing.assert_array_equal(change.T_world_points, T)


def test_another_scale_is_another_place_and_fewer_points_are_sent_anew():
    table, seen = PatchTable(), {}
    whole = patch(4, num=6)
    table.add(whole)
    table.place({4: np.eye(4)}, [4])
    table.changes_since(seen)
    table.add(DensePatch(4, whole.xyz, whole.rgb, whole.confidence, 2.0))
    table.place({4: np.eye(4)}, [4])
    (change,) = table.changes_since(seen)
    assert change.points is None
    np.testing.assert_array_equal(change.T_world_points, np.diag([2.0, 2.0, 2.0, 1.0]))
    table.add(whole.thinned())
    table.place({4: np.eye(4)}, [4])
    (change,) = table.changes_since(seen)
    assert len(change.points.xyz) == 3


def test_a_scene_moves_points_with_their_keyframe_and_forgets_them_with_the_map():
    scene, cursor = Scene(), Cursor()
    scene.set_keyframes(np.array([7]), np.eye(4)[None])
    scene.set_patches([patch(7)])
    changes = scene.changes_since(cursor)
    assert [p.frame_id for p in changes.patches] == [7]
    assert scene.changes_since(cursor).empty
    scene.set_keyframes(np.array([7]), exp_se3(np.full(6, 0.2))[None])
    (moved,) = scene.changes_since(cursor).patches
    assert moved.points is None
    (late,) = scene.changes_since(Cursor()).patches
    assert late.points is not None, "a viewer that comes late gets the points too"
    scene.start_new_map()
    changes = scene.changes_since(cursor)
    assert changes.cleared
    assert changes.patches == []
