"""Smaller adapters and bases, by calibration."""
