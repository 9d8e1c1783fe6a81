"""Wind at the height of people: results of several directions and a wind rose as maps of speed and comfort."""
