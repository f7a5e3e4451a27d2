"""Learned transceivers: encoder, decoder, confidence branch, checkpoints."""
