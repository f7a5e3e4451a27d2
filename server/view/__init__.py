"""What a person sees of a run: the scene and the viewers it is fed to.

Viewers
    feed            feeds a file and a live viewer beside the tracker
    settings        what is shown where
    rerun_viewer    layout and entities in Rerun, the only home of ``rerun``
    file_stream     the way into ``run.rrd``
    live_stream     the way to a live viewer, which may come late
    process         the viewer as a child process

Scene, as plain arrays with what each viewer has seen
    scene           path, landmarks, dense points, truth, plots, newest image
    path_table      the camera's path, in segments
    landmark_table  landmarks, in chunks
    patch_table     dense points, by keyframe
    spectator       the eye that follows the camera

One frame
    frame_view      what a frame contributes
    picture         its image and confidence, compressed
    state_text      the state of tracking in a line
"""
