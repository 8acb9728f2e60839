"""A network becomes a robot's policy: inputs, normalization, actions."""
