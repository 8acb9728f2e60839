"""Experiments on the study engine; not part of the installed package."""
