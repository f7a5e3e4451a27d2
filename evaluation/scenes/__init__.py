"""Scenes drawn by formula, with exact true paths: a room, a street, an orbit round a still life."""
