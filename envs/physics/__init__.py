"""MuJoCo MJX: the only folder that names an implementation of it."""
