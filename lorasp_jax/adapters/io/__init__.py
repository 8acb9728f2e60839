"""Adapters in files: this project's own and Hugging Face PEFT's."""
