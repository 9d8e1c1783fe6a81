"""Tiles in plan: their grid, corners, walls in pieces, and the strips in which a seam finds its way."""
