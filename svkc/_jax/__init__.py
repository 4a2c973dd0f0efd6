"""Code that depends on internals of JAX, XLA and equinox."""
