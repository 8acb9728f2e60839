"""Experts that solve the tasks, and demonstrations collected from them."""
