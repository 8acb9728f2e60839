"""Meta-World as data and judge."""
