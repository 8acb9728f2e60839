"""The console command `lorasp-jax` and what each of its commands does."""
