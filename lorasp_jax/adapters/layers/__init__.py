"""Adapted layers of each kind."""
