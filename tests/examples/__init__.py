"""Tests of the examples that are folders."""
