"""Pictures of the worlds, by ray casting."""
