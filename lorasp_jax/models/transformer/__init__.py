"""Transformer components shared by the backbones."""
