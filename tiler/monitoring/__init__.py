"""Who watches a run: events, progress, status, the terminal."""
