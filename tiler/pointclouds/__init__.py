"""Point cloud files: headers, chunks, COPC, and points dealt out to cells."""
