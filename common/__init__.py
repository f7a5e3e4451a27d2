"""What both ends share: images, geometry, codecs, physical layer, messages, transport.

Images and cameras
    image                   PSNR of two images, and other sizes
    image_file              image files as RGB arrays
    image_header            size of an image from its header
    tiff_alpha              whether OpenCV has applied the transparency of a TIFF
    levels                  grey levels, stretched before encoding
    camera                  pinhole, lens distortion, readout of the shutter
    camera_file             calibration files of many tools
    camera_settings         the camera on the command line
    lens                    models of lenses and their names, one camera for all images

Geometry and trajectories
    geometry                rotations, rigid and similarity transforms
    trajectory              timed poses; TUM files
    trajectory_error        ATE after Sim(3), RPE, completeness

Codecs (networks are in ``nets``, the physical layer in ``phy``)
    codec                   the interface of all codecs
    codecs                  codecs by name
    rate                    channel uses per frame; several rates from one model
    lost_detail             confidence of a picture coded at a smaller size
    conventional            JPEG, WebP or AVIF over LDPC and QAM
    conventional_source     its image compression
    conventional_transport  its bytes on the symbols of a frame
    symbol_payload          symbols as bytes of a message
    link_report             what a receiver reports about the link

Messages and transport
    messages                all messages, as frozen dataclasses
    message_fields          what each field may hold
    wire                    messages to bytes and back
    keys                    key expressions
    transport               Zenoh sessions
    network_settings        where processes meet
    reachability            why a hub is not reached
    loopback                hubs on free loopback ports
    mailbox                 bounded queues with named policies
    status_beat             status of a process, once a second
    metrics                 what a process counts about itself
    complaints              warnings about bad messages
    map_mirror              the map of a running server in another process

Recorded sequences (their folder layouts are in ``layouts``) and recordings
    sequence                a recorded sequence with random access
    times                   times of images: nanoseconds, and decimal seconds
    colmap_file             cameras and poses of a COLMAP model
    sequence_sizes          sizes of its image files
    image_order             the order of images by their names
    numbered_images         lines of a file, matched with images
    text_rows               lines of fields, without comments
    transforms_file         transforms.json
    ros_bag_files           tells ROS bags by how they look
    playback                which frames are played, and how fast
    recorder                records messages beside a running system
    recording_writer        MCAP files
    recording_reader        reads them, also cut off ones
    recorded_streams        the streams in a recording

Settings, files, processes
    config                  settings as frozen dataclasses, TOML
    config_flags            settings from flags and TOML files
    argument_order          the order of words on a command line
    errors                  errors a user can act on
    shapes                  shape checks
    run_folder              the folder of a run
    run_summary             the figures of a finished run
    new_folder              folders for output
    former_file             keeps a file that would be written over
    file_lock               locks on what is being written
    whole_file              files that are never half written
    npz_file                arrays with a header
    source_commit           the commit that the code is of
    cores                   processor cores and threads
    heap                    memory that frames take again and again
    interrupts              signals that end a run, Ctrl-C among them
    leaving                 the end of a process whose threads still work
    role                    a process of a running system as a child
    parent                  children that end with the process that started them
    worker_guard            unexpected exceptions in worker threads
"""
