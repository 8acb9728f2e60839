"""Training: mesh, step, optimizer, checkpoints and the loop around them."""
