"""What a finished run shows a person; reads the files of a run folder only."""
