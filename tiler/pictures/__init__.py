"""Pictures of a run, drawn off-screen."""
