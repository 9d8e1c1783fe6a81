"""Houses from rules: parameters of a building drawn by rules, and its geometry in 16 levels of detail."""
