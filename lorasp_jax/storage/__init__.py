"""Where files are, and how one knows that they are what was written."""
