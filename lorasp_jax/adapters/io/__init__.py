"""Adapter files in this project's format and in Hugging Face PEFT's."""
