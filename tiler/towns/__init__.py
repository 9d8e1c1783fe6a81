"""Synthetic towns of houses that are drawn by rules: parameters, city models, footprints and point clouds."""
