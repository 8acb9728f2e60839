"""Reports of a run, generated only from the files in its folder."""
