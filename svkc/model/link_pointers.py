"""The link pointers of the paper (section III): parent, child, brother and real link by index."""

import numpy as np
from jaxtyping import Array, Int

from svkc.model.topology import Topology


def link_pointers(
    topology: Topology,
    link_parent: Int[Array | np.ndarray, " links"],
    link_real: Int[Array | np.ndarray, " links"],
) -> np.ndarray:
    """Return the table [4, bodies + links] of parent, child, brother and real link.

    Columns of bodies come first, then columns of virtual links; entries are column indices, and -1
    is none. Spare links have no parent and no real link.

    link_parent, link_real: topology rows of the parent and of the real link of each virtual link.
    """
    bodies, count = len(topology.body_names), len(topology.body_names) + len(topology.link_names)
    body_of_row = np.full(len(topology.parent), -1)
    for body, row in enumerate(topology.body_row):
        body_of_row[row] = body
    table = np.full((4, count), -1)
    for body in range(1, bodies):
        row = topology.parent[topology.body_row[body]]
        # a body with several joints has several rows, of which the last is the body's
        while body_of_row[row] < 0:
            row = topology.parent[row]
        table[0, body] = body_of_row[row]
    for link, spare in enumerate(topology.link_spare):
        if not spare:
            table[0, bodies + link] = body_of_row[int(link_parent[link])]
            table[3, bodies + link] = body_of_row[int(link_real[link])]
    for parent in range(bodies):
        children = np.flatnonzero(table[0] == parent)
        if len(children):
            table[1, parent] = children[0]
            table[2, children[:-1]] = children[1:]
    return table
