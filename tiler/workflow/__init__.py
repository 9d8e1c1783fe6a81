"""A run from configuration to record: stages in their order, folder, failed tiles, summary."""
