"""Dense depth of keyframes and the coloured cloud they make: what a person sees of the place.

Nothing here moves a pose or a landmark.

    builder      follows the map and has depth estimated, live or at the end
    process      the process that does it
    view         an image as depth is sought in it
    neighbours   which views it is compared with, and between which depths
    plane_sweep  how well they agree at each depth
    semi_global  smoothing by semi-global matching
    depth_map    one keyframe's depth
    consistency  what other keyframes confirm
    cloud        points of all keyframes
"""
