"""Training of the learned transceivers: data, losses, loop."""
