"""Locate model files, and detect corrupted ones."""
