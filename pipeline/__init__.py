"""The DTCC Builder algorithm, in packages by its steps: pure functions on arrays, one tile, one process."""
