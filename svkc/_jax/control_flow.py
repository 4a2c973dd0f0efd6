"""Control flow from `equinox.internal`, imported in one place because that interface may change."""

# unvmap_any reduces over all lanes of a `vmap`, so that a `lax.cond` on it stays a `lax.cond`;
# while_loop and buffer_at_set write rows of buffers in place
from equinox.internal import (
    buffer_at_set as buffer_at_set,
    unvmap_any as unvmap_any,
    while_loop as while_loop,
)
