"""Backbones, policies and what surrounds them; a backbone is a folder here, found by its name."""

from lorasp_jax.models import pi0

__all__ = ["pi0"]
