"""The command line: parser, handlers, values with a minus sign."""
