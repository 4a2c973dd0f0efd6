"""Data types (`Chain`, `Structure`, `State`, `VirtualLink`), topology, names and validation."""
