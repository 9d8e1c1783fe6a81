"""The DTCC Builder algorithm, one step a room: pure functions on arrays, one tile, one process."""
