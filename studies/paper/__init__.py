"""The study of the paper: LoRA-SP against its baselines on four PiPER tasks."""
