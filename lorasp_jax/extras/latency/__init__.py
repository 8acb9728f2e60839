"""Success and smoothness of a policy whose chunks arrive late."""
