"""What `citystitch check` proves from the written files."""
