"""Products built on the core, each with its own optional dependencies."""
