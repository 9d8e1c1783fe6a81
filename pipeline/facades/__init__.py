"""Façades by rules: a graph of splits and repeats on a rectangle, assets with a share of their polygons."""
