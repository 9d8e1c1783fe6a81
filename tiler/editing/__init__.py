"""Edits of a finished run folder: buildings replaced, removed and added, each edit a transaction."""
