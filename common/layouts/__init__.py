"""Folder layouts of recorded sequences: each is read into the same ``SequenceFiles``.

What they share
    layout    which layout a folder has, and what is in it
    files     what a sequence consists of; lists, times and calibrations beside images

Layouts
    folders   semcast's own layout, and plain folders of images
    tum       the TUM RGB-D benchmark
    kitti     KITTI odometry
    euroc     EuRoC
    models    ``transforms.json`` of NeRF, and COLMAP models
"""
