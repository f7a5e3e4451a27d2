"""Offline measurement of codecs, relative poses and trajectories on the same core as the live system."""
