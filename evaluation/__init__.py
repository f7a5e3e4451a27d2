"""Offline measurement of codecs, relative poses and trajectories, on the same core as the live system.

``docs/results.md`` has the outcome with the commands that made it, ``results/`` the files behind it. A module
named after a verb of ``semcast eval`` is that verb.

Verbs of ``semcast eval``
    trajectory          error of the camera path over a link
    pairs               relative pose of frame pairs
    codec               image quality over a link
    confidence          what confidence maps are worth
    depth               depth maps from decoded images
    latency             time of each stage of a frame
    endurance           cost and memory over a long run
    server              time a live server takes, without agent and channel
    recording           cost of recording beside a stream
    runtime             speed of codecs

Frames and reconstructions
    pipeline            recording, codec, link, decoded image
    reconstruct         reconstruction of one run in this thread
    live_poses          errors of poses as they were published, and what they say of themselves
    gap                 a gap in the stream
    sounding            the SNR a transmitter is told first
    trace_snr           the SNR of a link that follows a trace
    scene_suite         trajectories on drawn scenes
    runtime_child       one variant of ``runtime``, in its own process
    speed_table         how long one image takes, for the README

Calibration from images of the camera alone
    moving_images       what images of a moving camera tell of the camera
    lens                ``semcast lens``: focal length, distortion, principal point
    readout             ``semcast shutter``: readout time of a rolling shutter

Frame pairs
    pair_suite          the whole pair benchmark
    pair_cell           errors and comparisons of one cell
    pair_matches        matches of two decoded images
    pair_methods        estimators under one signature
    competitors         estimators without confidence
    match_truth         which matches are right
    pose_error          errors of relative poses

Grades
    statistics          ranks, AUROC, percentiles, bootstrap
    calibration         calibration error, reliability, sparsification
    confidence_grades   confidence against what really happened
    uncertainty_maps    maps a confidence has to beat
    image_quality       SSIM and MS-SSIM
    keyframe_depth      depth maps of keyframes
    cloud_error         dense clouds against drawn scenes
    loss_ablation       what each loss term does
    lost_detail         confidence of pictures coded at a smaller size: fit and grades

Reports, tables and pictures
    report              results as JSON with provenance
    interruption        the finished part of a measurement that is ended
    result_table        what a verb prints
    results_page        docs/results.md and generated parts of other pages
    markdown            tables, and parts between markers
    path_tables         tables of path errors
    pair_summary        tables of frame pairs
    trajectory_summary  what confidence does to paths
    link_summary        the same by link, over all recordings
    mode_summary        what of that is confidence itself
    depth_summary       what confidence does to depth maps
    plots               plots of results
    run_plots           plots of one run
    picture_strip       decoded images side by side
    scene_picture       pictures of drawn scenes
"""
