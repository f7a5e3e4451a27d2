"""Estimators without a state: arrays in, arrays out.

Pixels are ``(N, 2)``, camera axes x right, y down, z forward, and ``T_a_b`` maps points of b to a.

Observations and their noise
    weighting        from confidence to standard deviations; fits the noise model to residuals
    edges            anisotropic errors: how much better a point is known across an edge than along it

Points in images
    grey             grey images
    corners          corners to follow
    klt              points followed from image to image (Lucas-Kanade)
    descriptors      binary descriptors (ORB) and their matches
    warped_points    KLT in windows that are turned, scaled or sheared
    patch_alignment  patches of two images, aligned to a fraction of a pixel
    wide_search      matches by SIFT, however far points moved
    sampling         values of an image at points
    brightness       change of exposure between two images
    flicker          bands of light that lamps leave in images of a rolling shutter
    streaks          motion blur that differs between two images
    cells            cells of an image by one number each
    square_distance  squared distances, all with all

Two views
    two_view         relative pose from matches: the choice among candidates, which is then refined
    two_view_candidates  poses that searches find, near pure turning, and of a plane
    two_view_refinement  refinement, with the noise and the edges that a pair itself tells
    epipolar         residuals of a relative pose, cheirality, refinement
    agreement        how far each match moves like its neighbours
    lo_ransac        PoseLib's LO-RANSAC
    ransac           the paper's confidence-weighted RANSAC
    turning          rotation between two images by small blurred versions of them

Pose and structure
    pnp              pose from landmarks
    ray_observations and from points of which only the ray is known
    triangulation    points from rays
    projection       world points in a camera, and the derivatives of their pixels
    motion           constant-velocity prior
    bunches          frames that come in bunches, and whether their times mislead
    gap_bridge       how the camera got across a gap, and how far off that is
    jump             whether a camera that went steadily jumped
    whereabouts      where the camera can have got to in a gap

Numbers
    finite_differences  the derivative of what is known at a few moments
"""
