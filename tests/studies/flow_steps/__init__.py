"""Tests of studies/flow_steps."""
