"""Learned transceivers: encoder, decoder, confidence branch, checkpoints.

Codecs
    codec             a trained transceiver behind the codec interface
    inference         the same figures with fewer passes over memory
    precision         what convolutions are computed in
    int8              convolutions of eight-bit integers
    checkpoint        weights on disk
    manifest          what weights are, beside them
    registry          architectures by name
    onnx_encoder      the sending end without torch

Transceiver of 3DC-SC
    transceiver       encoder, modulation, decoder and confidence branch
    encoder           channel attention and residual units over four reductions
    decoder           the linear estimate, refined
    confidence        the confidence branch
    linear            block transform, mixing and Wiener filter
    blocks            building blocks

Baselines
    cnn               plain convolutions
    vit               a transformer
    mae               the same with masked pre-training

From values to symbols
    coder_input       what an encoder is given
    detail            which blocks ask for many values
    packing           values of blocks as those of slots
    latent            which value is which part of which symbol
    modulation        analog, or rounded to the levels of 16-QAM
    modulation_numpy  the same without torch
    rounding          statistics of rounded values
"""
