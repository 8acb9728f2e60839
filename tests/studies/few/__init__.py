"""Tests of studies/few."""
