"""The mobile side: read a camera, encode each frame, publish channel symbols.

Process
    agent            captures, encodes and publishes, in live or lossless service
    settings         settings of the process
    peers            waits until channel and server are there
    capture          reads the source on a thread of its own
    encoder          from an image to the message with its channel symbols
    pace_control     how many of the camera's frames are sent
    replay_window    lossless sending: repeats what got lost
    originals        publishes original frames for recordings
    play             puts a recorded stream back on the network

Sources of frames
    source           one interface over sequences, videos and live cameras
    source_settings  which frames are sent, and how fast
    video            video files, webcams and network cameras
    video_times      when the frames of a video were taken

ROS bags
    unpack           a bag as a recorded sequence
    ros_bag          reads bags of versions 1 and 2 without ROS
    ros_bag_parts    tells the parts of a split bag
    ros_image        images of ROS messages as image files
    frame_tree       coordinate frames over time, as in ``tf``

Calibration
    calibrate        intrinsics from views of a chessboard
"""
