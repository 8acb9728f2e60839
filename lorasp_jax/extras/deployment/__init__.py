"""Forms in which a finished LoRA-SP run can be deployed, made and compared by one command."""
