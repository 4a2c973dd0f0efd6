"""Mobility of a structure (paper (13)): freedoms, rank, redundant rows."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.select import where
from svkc.loops.constraint import loop_kinematics
from svkc.loops.coordinates import coordinates
from svkc.loops.pivoting import count_rank, pivot_ratio, pivoted_qr
from svkc.model.chain import Chain, State, active_dofs
from svkc.model.chain_names import ChainNames
from svkc.model.checked_jit import checked_jit
from svkc.model.tables import Block, Printed, Table, ranges


class Mobility(Printed):
    """Mobility of a structure. `print` shows it with the names of links and coordinates.

    freedoms: mobility N_F = N_J - m (paper (13)). joint_freedoms: N_J. rank: m of the phase.
    redundant: number of rows of each loop that depend, at q, on its others and on earlier loops.
    independent: mask of theta_G.
    margin: |R_mm| / |R_11| of the pivoted QR of J_C, the distance from a lower rank.
    connected: which virtual links are connected.
    names: names of the chain's bodies, joints, links and coordinates.
    """

    freedoms: Int[Array, ""]
    joint_freedoms: Int[Array, ""]
    rank: Int[Array, ""]
    redundant: Int[Array, " links"]
    independent: Bool[Array, " dofs"]
    margin: Float[Array, ""]
    connected: Bool[Array, " links"]
    names: ChainNames = eqx.field(static=True)

    @property
    def link_names(self) -> tuple[str, ...]:
        """Names of the virtual links."""
        return self.names.links

    @property
    def dof_names(self) -> tuple[str, ...]:
        """Names of the joint coordinates; see `Chain.dof_names`."""
        return self.names.v

    def _blocks(self) -> list[Block]:
        if np.ndim(self.rank):
            return self._blocks_of_lanes()
        independent = [n for n, on in zip(self.names.v, self.independent, strict=True) if on]
        numbers = [
            ("joint freedoms (N_J)", str(self.joint_freedoms), ""),
            ("rank of the loops (m)", str(self.rank), f" margin {float(self.margin):.2e}"),
            ("mobility (N_F = N_J - m)", str(self.freedoms), ""),
        ]
        loops = [
            (f"  {name}:", f"6 rows, {int(rows)} of them redundant" if on else "not connected")
            for name, on, rows in zip(self.names.links, self.connected, self.redundant, strict=True)
        ]
        line = f"independent coordinates: {', '.join(independent) or 'none'}"
        return [Table((), numbers), line, *[Table((), loops)] * bool(loops)]

    def _blocks_of_lanes(self) -> list[Block]:
        """Return the ranges over the lanes of a batch, and how many lanes close each loop."""
        values = {
            "joint freedoms (N_J)": self.joint_freedoms,
            "rank of the loops (m)": self.rank,
            "mobility (N_F = N_J - m)": self.freedoms,
            "margin of the rank": self.margin,
        }
        links = len(self.names.links)
        lanes = np.size(self.rank)
        counts = np.asarray(self.connected).reshape(lanes, links).sum(0).tolist()
        redundant = np.asarray(self.redundant).reshape(lanes, links)
        rows = [
            (name, str(counts[i]), str(redundant[:, i].min()), str(redundant[:, i].max()))
            for i, name in enumerate(self.names.links)
        ]
        titles = "loop", "lanes in which\nit is connected", "redundant rows\nmin", "max"
        heading = f"Mobility of {'x'.join(map(str, np.shape(self.rank)))} lanes"
        return [heading, ranges(values), *[Table(titles, rows, 12)] * bool(rows)]


@checked_jit(eager=True)
def mobility(chain: Chain, state: State) -> Mobility:
    """Return the mobility of the state's structure, with the rank that its phase has."""
    active = active_dofs(chain, state.structure)
    joint_freedoms = jnp.sum(active, dtype=jnp.int32)
    links = len(chain.link_names)
    if not links:
        zero = jnp.zeros((), jnp.int32)
        unit_margin, none = jnp.ones((), state.q.dtype), jnp.zeros(0, jnp.int32)
        return Mobility(
            freedoms=joint_freedoms,
            joint_freedoms=joint_freedoms,
            rank=zero,
            redundant=none,
            independent=active,
            margin=unit_margin,
            connected=none > 0,
            names=chain.names,
        )
    J = loop_kinematics(chain, state.structure, state.q).J
    # ranks of the rows of the first loop, of the first two loops, and so on
    first_loops = np.arange(6 * links)[None] < 6 * np.arange(1, links + 1)[:, None]
    ranks = jax.lax.map(
        lambda rows: count_rank(
            pivoted_qr(where(rows[:, None], jax.lax.stop_gradient(J), 0)).diag_R
        ),
        jnp.asarray(first_loops),
    )
    rows = where(state.structure.connected, 6, 0).astype(jnp.int32)
    redundant = rows - jnp.diff(ranks, prepend=jnp.zeros(1, jnp.int32))
    rank = state.structure.rank
    return Mobility(
        freedoms=joint_freedoms - rank,
        joint_freedoms=joint_freedoms,
        rank=rank,
        redundant=redundant,
        independent=coordinates(chain, state).independent,
        margin=pivot_ratio(pivoted_qr(J, rank)),
        connected=state.structure.connected,
        names=chain.names,
    )
