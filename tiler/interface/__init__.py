"""The Python interface: what `import tiler` gives."""
