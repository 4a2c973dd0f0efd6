"""What depends on the internals of JAX, XLA and equinox."""
