"""Where adaptive rank pays: LoRA-SP and LoRA by rank, and ranks by layer."""
