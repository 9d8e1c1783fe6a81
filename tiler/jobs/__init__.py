"""Runs as jobs of a batch system: submission, the controller's job, and workers as further jobs."""
