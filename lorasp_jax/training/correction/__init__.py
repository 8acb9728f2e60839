"""Train the correction head of a finished run; see `policies.correction`."""
