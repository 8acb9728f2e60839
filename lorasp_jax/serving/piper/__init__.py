"""The AgileX PiPER as the client of a policy server: its driver, and the checks before it."""
