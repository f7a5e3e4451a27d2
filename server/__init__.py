"""The receiving side: decode, track, map, refine, show, export."""
