"""Step 2.0: roofs of houses: parts of one height, and planes in their points."""
