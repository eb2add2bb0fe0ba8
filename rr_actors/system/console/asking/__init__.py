"""What is asked of a running system from outside, beside its resources: calls of actors, and waiting for states."""
