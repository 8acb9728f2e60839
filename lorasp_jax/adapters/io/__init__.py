"""Adapter files in this project's format and in that of Hugging Face PEFT."""
