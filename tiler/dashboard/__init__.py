"""The page of a run: its state from the events that its driver writes, and the server that shows it."""
