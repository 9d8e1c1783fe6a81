"""What the formats of `citystitch export` share: the pieces of a run, faces of the region, patches, surfaces."""
