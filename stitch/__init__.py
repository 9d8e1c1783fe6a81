"""What two tiles must agree on: seams, numbering, conformity. Arrays only, no files."""
