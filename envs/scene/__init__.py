"""The scene: table, cameras, objects and their randomization."""
