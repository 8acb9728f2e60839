"""The console command `lorasp-jax` and its subcommands."""
