"""LoRA-SP (arXiv 2603.07404)."""
