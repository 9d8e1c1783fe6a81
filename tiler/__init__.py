"""Everything with a clock, a disk or a process: region, files, runs, the command line."""
