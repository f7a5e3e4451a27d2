"""The receiving side: decode, track, map, refine, show, export.

``server.Server`` is the process. It takes frames from ``receiver``, has them decoded, and gives them to a
``session``, which holds the reconstruction (``mapping``) of one start of one agent and its results.
``replay`` does the same from a recording.

Process
    server            receives, decodes, tracks and maps one stream at a time
    settings          settings of the process
    replay            the same from a recording, without a network
    record            records everything that is sent, beside a running system
    control           what other processes may ask of a server
    requests          hands their requests to the thread that may serve them
    worker            work in a child process that is started again when it dies

Arrival of frames
    receiver          frames in order, equalised and ready for the decoder
    feedback          what the agent is told: the link's quality, how far the server is
    arrival           which frames count: epochs, duplicates, order, gaps, age
    backlog           frames that wait for the decoder
    decoder           from symbols to an image with confidence
    decode_ahead      decodes one frame ahead of the tracker, on a thread
    recorded_order    frames of a recording in order
    sent_frames       which frames were sent, told by those that arrived

Beginning and end of a stream
    announcement      streams that agents announce
    stream_identity   what one start of one agent is
    succession        the session of each stream, after the one before is written
    former_starts     late frames of an agent that was started again
    former_run        what an earlier run left in the output folder
    false_start       a checkpoint whose newest frame the stream has not reached
    stream_end        when nothing more is to come
    conclusion        the last adjustment and missing depth

One stream
    session           the map of one start of one agent and its outputs
    session_cloud     its dense cloud
    session_records   its rows, checkpoints and images, written on the way
    bundle_runner     where its bundle adjustment runs
    checkpoint        what a restarted server needs to go on with the map
    metres            the scale of the map, by a printed marker
    marker_settings   which marker
    reference         originals and true path, where they are known

Results
    frame_rows        one row per frame
    run_summary       the figures of a run, made of its rows and its path
    run_results       trajectory, landmarks and files for exports
    image_writer      keeps decoded images
    outbox            publishes poses and map
    viewing           whether and where a run is shown
    frame_views       what the viewer is shown of a frame

Folders: ``geometry`` (estimators without a state), ``mapping`` (the reconstruction), ``dense`` (depth of
keyframes), ``view`` (viewers), ``export`` (forms for other tools).
"""
