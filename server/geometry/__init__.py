"""Estimators without a state: two views, pose from points, triangulation, features, weights."""
