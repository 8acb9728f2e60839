"""Load and save backbone weights, in this project's layout and in published layouts."""
