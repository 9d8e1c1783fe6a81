"""Results on a disk or in a bucket: arrays, checksums, audit, lock."""
