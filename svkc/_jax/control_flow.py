"""Control flow of equinox that its public interface lacks."""

# unvmap_any: whether any lane of a `vmap` is true, for a `lax.cond` that stays one. while_loop,
# buffer_at_set: rows of buffers written in place
from equinox.internal import (
    buffer_at_set as buffer_at_set,
    unvmap_any as unvmap_any,
    while_loop as while_loop,
)
