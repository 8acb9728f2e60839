"""What stands on the table, and where."""
