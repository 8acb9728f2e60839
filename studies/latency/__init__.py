"""Execution under latency, compared."""
