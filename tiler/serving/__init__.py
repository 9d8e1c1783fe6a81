"""The service of a run folder: its 3D Tiles, a page that shows them, and edits over HTTP for one writer."""
