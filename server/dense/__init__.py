"""Dense depth of keyframes and the coloured cloud they make: what a person sees of the place.

``view.py``: an image as depth is sought in it. ``neighbours.py``: which views it is compared with, and
between which depths. ``plane_sweep.py``: how well they agree at each depth. ``semi_global.py``: smoothing.
``depth_map.py``: one keyframe's depth. ``consistency.py``: what other keyframes confirm. ``cloud.py``: points
of all keyframes. ``builder.py``: follows the map and has depth estimated, live or at the end. ``process.py``:
the process that does it. Nothing here moves a pose or a landmark.
"""
