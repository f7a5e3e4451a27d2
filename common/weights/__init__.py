"""Shipped weights with their manifests; ``semcast.common.nets.checkpoint`` reads them."""
