"""`citystitch join`: processes that work at one run through its folder alone."""
