"""Scripted experts that solve the tasks, and the collection of their demonstrations."""
