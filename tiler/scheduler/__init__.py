"""Somebody's Dask scheduler: the way to it, TLS, and what its workers must meet."""
