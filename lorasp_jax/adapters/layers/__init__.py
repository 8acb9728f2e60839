"""Adapted layers: einsums, embeddings and convolutions, and layers prepared for inference."""
