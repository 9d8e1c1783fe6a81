"""Files that solvers and viewers read as they are, one format a file: see `tiler.formats.export.FORMATS`."""
