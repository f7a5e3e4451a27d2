"""Shipped weights with their manifests; ``semcast.common.nets.checkpoint`` and ``manifest`` read them."""
