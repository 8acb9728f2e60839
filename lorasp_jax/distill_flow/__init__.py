"""Distillation of a flow policy's sampler: as good with fewer flow steps."""
