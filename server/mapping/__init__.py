"""The reconstruction: decoded frames in, camera poses and a map out.

Start at ``reconstruction.Reconstruction``: one object per stream, one call per frame. It follows tracks, asks
``locator`` for the pose and hands keyframes to ``map_builder.MapBuilder``, which owns the map. What follows
tells where things are; ``docs/architecture.md`` tells why they are done as they are.

The frame
    reconstruction    the state machine: initialising, tracking, lost; what each frame goes through
    state             DecodedFrame in, FrameResult and MapUpdate out
    settings          all settings
    sight             one image with the rows that arrived, and the tracks seen in it
    blank             images that show nothing
    outage            frames of which a link in an outage let little through
    rolling_shutter   images and tracks as if all rows had been exposed at once
    camera_motion     motion prior; images that stay while the camera goes on

Tracks (2D)
    tracks            the table of tracks: KLT from image to image, new corners, confidence
    recent_images     the newest images, from which tracks are followed: in one light, and after a jump
    track_ids         where ids stand among others: what two images, or an image and the map, share
    found             where tracks were found in an image, as one search follows another
    standing          tracks fixed in the image: a bonnet, a watermark, dirt on the lens
    passing           what passes before a camera at rest, and is no motion of the scene
    refuted           tracks on something large that moves by itself
    anchoring         drift of tracks, taken out by alignment with patches of keyframes

Pose of a frame
    locator           what is tried for a frame's pose: its tracks, then landmarks that lost theirs
    tracker           pose from landmarks (PnP), steadied by rays
    rays              tracks without a depth, on rays from keyframes
    recall            lost landmarks, looked for again where the pose expects them

Start of a map
    beginning         frames without a pose are kept, and become a part of the map
    initialiser       two views with parallax, the frames between them, and an adjustment
    scene_motion      whether a relative pose is that of the scene or of a large moving thing
    start_geometry    frames between two views of known motion, and points of them all
    start_alignment   drift of the tracks a map begins with
    start_attempts    which attempts at a start are put off, and which are made again
    ambiguity         which of several structures that fit the first views is right
    depth_reversal    the one mirrored in depth (Necker reversal)
    planar_ambiguity  the second pose and plane of a homography
    bas_relief        the bas-relief ambiguity
    hypotheses        structures kept from one attempt to the next
    kept_frames       frames that wait for a map, and their poses once there is one
    look_back         the map grows backwards over those frames

The map
    world_map         landmarks, keyframes, poses of all frames, and what has changed
    landmarks         landmarks as columns
    posed_frames      poses of frames relative to their keyframes, as arrays
    map_builder       owns the map: keyframes, adjustments, joining of submaps
    keyframe_rule     when a frame becomes a keyframe
    new_landmarks     tracks of keyframes, triangulated
    observations      what keyframes saw of some tracks
    drift             how far keyframes may be off against the start, which adds up on the way
    pose_covariance   how well a pose is known, against the newest keyframes and the start of the map
    scene_depth       how far away the scene is
    thinning          what goes when the map reaches its limits
    keyframe_images   images of keyframes, kept to look for landmarks by how they looked there
    scale_watch       whether keyframes hold the scale of those before
    contradiction     whether tracks alone tell another motion than the map
    rebuilding        the newest keyframes are built anew where they do
    map_arrays        checks the arrays of a checkpoint
    map_update        what of the map goes out to those who follow it

Bundle adjustment
    window            chooses keyframes and observations of a window
    bundle_problem    the problem and its result, as plain arrays
    bundle            solves a problem: dense for small ones, GTSAM for the rest
    dense_bundle      Levenberg-Marquardt with the Schur complement in numpy
    bundle_process    the same in a process of its own
    window_covariance how well a window's keyframes are known, with errors that neighbours share (jackknife)
    adjuster          asks for adjustments of a growing map, and takes them and what they tell
    adjustment        brings the result into the map, and lets what it had no room for follow
    whole_map         the adjustment of all keyframes at the end of a stream
    steps             relative poses that tracking found, as constraints between keyframes

Getting lost, and places seen again
    recognition       which of the next two is asked, and where the camera can be
    relocalisation    binary descriptors against keyframes, then PnP; joining two submaps
    wide_recognition  the same by SIFT and warped patches, from further off
    visual_gyroscope  how a camera without a pose turns
    bridging          where a new submap begins and its unit, told by how the camera moved
    guessed_place     how far off that may be, for every pose there until the submap is joined
    submap_placement  puts it there, and again once it has settled, or the camera is back from it
    known_end         where it is, by the guess of its beginning and by where it ended
    joining           whether the camera can have got to where a place joins two submaps
    revisit           old landmarks that are in sight again get their tracks back
    loop_closure      finds loops and shares out the drift
    pose_graph        graph of similarities (Sim(3)) between keyframes, by GTSAM

What residuals say about the camera
    residual_patterns how residuals depend on shutter and lens, with poses and points eliminated
    readout           the readout time of a rolling shutter
    lens              focal length, radial distortion and principal point
    lens_doubt        whether the lens of the calibration is another one, in words
    readout_watch     asks for both as the map grows
    late_readout      puts a map right that was begun before its shutter was known

Words of this folder:

* *sight*: what one image shows. *seen*: tracks in it with their positions. *track id* = *landmark id*.
* *submap*: a part of the map with a scale of its own, begun where tracking was lost, merged when it is
  recognised.
* *refuted*: no static point explains the track. *standing*: the track stays in place in the image.
* *edge*: the anisotropy of an observation's covariance, see ``geometry.edges``.
* *born*: the keyframe that made a landmark. *posed*: has a pose. *unit*: the length that is 1 in the map.
"""
