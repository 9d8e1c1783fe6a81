"""Words that users read: notes, steps, suggestions, safe text."""
