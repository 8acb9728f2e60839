"""Combine several adapters in one model."""
