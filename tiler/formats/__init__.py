"""One file format a module, by its name, with a `tiler.export.export.Format` called ``FORMAT``."""
