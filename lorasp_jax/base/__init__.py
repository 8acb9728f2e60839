"""Files, locks, downloads, console and XLA settings: the one package that `envs` shares."""
