"""Runs as jobs of a batch system: the cluster's table, submission, the controller, and workers as jobs."""
