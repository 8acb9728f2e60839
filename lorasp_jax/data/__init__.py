"""From episodes to training batches."""
