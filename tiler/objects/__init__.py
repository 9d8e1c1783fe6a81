"""Runs in a bucket, and inputs from S3 and HTTP: places on a disk or in a bucket, requests, results."""
