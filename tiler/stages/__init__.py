"""The stages of a run: what is computed for each file, tile and seam, and what each of these reads."""
