"""Several adapters on one model."""
