"""What a run leaves behind, and its forms for other tools.

Files of a run
    outputs     PLY map, timed trajectory, JSON without NaN
    geometry    observations of a run, and their reprojection errors

Other tools
    formats     exports by format name
    poses       TUM and KITTI trajectories
    colmap      COLMAP's text model
    nerfstudio  ``transforms.json`` of nerfstudio and gsplat
    replacement a model in place of an earlier one
    rrd         a Rerun recording

Part, unit and frame
    parts       parts of a map that never met
    placement   metres and axes by a known path
    markers     metres and axes by a printed marker
"""
