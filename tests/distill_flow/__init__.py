"""Tests of lorasp_jax.distill_flow."""
