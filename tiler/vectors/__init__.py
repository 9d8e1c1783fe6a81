"""Vector files: what a layer says about itself, and its features as they are stored."""
