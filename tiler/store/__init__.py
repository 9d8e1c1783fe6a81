"""The folder of a run: results, checksums, lock, names of files, record."""
