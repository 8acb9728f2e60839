"""Adapting whole models."""
