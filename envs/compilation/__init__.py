"""How XLA compiles for simulation, and what it says meanwhile."""
