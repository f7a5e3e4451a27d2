"""Training of the learned transceivers: data, losses, loop.

Run
    loop          one process or several, on a CPU or a GPU, resumable
    run           model, average and optimisers of a run, and its checkpoint
    settings      settings of a run
    optimisers    which weight is trained by which optimiser, and how fast
    muon          the Muon optimiser
    validation    PSNR of whole images
    curve         loss and PSNR over the steps
    divergence    losses and weights that are no longer finite

Data
    data          images, and crops cut and changed at random
    channel       the differentiable link: fading, loss, noise, equaliser
    allocations   how many values each block sends
    draws         crops, links and allocations of a step

Losses
    losses        reconstruction, descriptors, confidence
    descriptors   dense descriptors of the consistency term
    displacement  label of the keypoint head, by one Lucas-Kanade step
    masked        masked pre-training

First weights
    klt           the best linear transceiver of the training images
    growing       from a smaller network
    varying       from a network of fixed rate
    centring      keeps hidden units from switching off for good

Export
    onnx_export   the encoder as an ONNX file
    onnx_int8     its convolutions in eight bits
"""
