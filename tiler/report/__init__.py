"""The report of a run: one page of what was made, how good it is, what was left out, and where the time went."""
