"""Forms in which LoRA-SP runs can be deployed, compared."""
