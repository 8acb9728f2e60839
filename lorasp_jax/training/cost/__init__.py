"""Cost of a run: memory, floating-point operations and speed, estimated and measured."""
