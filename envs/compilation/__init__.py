"""XLA settings for simulation, compilation cache and messages."""
