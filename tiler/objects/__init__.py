"""Runs in a bucket, and inputs from S3 and HTTP: requests, objects as paths, the lease, and what is fetched."""
