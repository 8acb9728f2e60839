"""Adapt whole models, and save, combine and compress their adapters."""
