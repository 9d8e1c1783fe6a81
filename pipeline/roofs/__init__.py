"""Step 2.0: roofs of houses: parts of one height, planes in their points, straight skeletons of outlines."""
