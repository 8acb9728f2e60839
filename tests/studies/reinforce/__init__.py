"""Tests of studies/reinforce."""
