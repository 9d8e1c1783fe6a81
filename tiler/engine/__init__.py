"""The stage engine: stages, tasks, keys, records, failures."""
