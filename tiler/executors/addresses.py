"""Where servers of a run listen."""

ANYWHERE = "127.0.0.1:0"  # a free port of this machine, for this machine
