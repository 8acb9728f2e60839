"""Compress adapters and bases: pruning, distillation, quantization, calibration statistics."""
