"""Pictures of a run, drawn off-screen by pyvista."""
