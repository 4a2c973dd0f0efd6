"""Changes of structure: initial state, connect, cut, lock, impact, spare links, events, guards."""
