"""Where tasks run: this process or worker processes of this machine, and how these start."""
