"""The nouns (chain, structure, state, virtual link), the topology, names and the validation of
arguments."""
