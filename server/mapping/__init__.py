"""The reconstruction: tracks, the map as it grows, bundle adjustment, recognising places."""
