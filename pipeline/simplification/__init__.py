"""Steps 2.1 and 2.2: the city model simplified, by one planar graph of walls or the paper's way."""
