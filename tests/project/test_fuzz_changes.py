"""Random sequences of connect, cut, lock, bind and transition, checked in numpy.

After each change the structure is that of a Python set, loops and their rates are closed, the
velocity is that of an inelastic impact, and energy, momentum, mobility and accelerations are those
of `references/rigid_bodies.py`. Without an impact q and v stay bit for bit. A sample is the seed of
its geometry, masses and changes.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import mechanisms
import numpy as np
import pytest
from references import rigid_bodies

import svkc
from svkc.transitions.transition import change_structure

OPERATIONS = ("connect", "here", "cut", "lock", "unlock", "bind", "unbind", "transition")
JOINTS = ("weld", "hinge", "slide", "ball", "planar", "cylinder", "free")


class Changes:
    """A state, the random changes that are made to it, and what is wrong with them."""

    def __init__(self, name, seed):
        self.rng = rng = np.random.default_rng(seed)
        self.sample = mechanisms.sample(name, rng, 0.5)
        self.chain, self.bodies = self.sample.chain, self.sample.bodies
        chain, links = self.chain, len(self.chain.link_names)
        connected = np.array(chain.structure.connected) & (rng.random(links) < 0.5)
        structure = eqx.tree_at(lambda s: s.connected, chain.structure, jnp.asarray(connected))
        q = self.sample.q[None]
        basis = self.bodies.motions(rigid_bodies.batched(structure), q)[0][0]
        v = basis @ rng.normal(size=chain.dofs) * 3
        near = svkc.State(jnp.asarray(q[0]), jnp.asarray(v), structure)
        self.state = chain.state(q[0], v, near=near)
        self.connected, self.bound = set(np.flatnonzero(connected).tolist()), set()
        self.log, self.wrong = [f"{name}, seed {seed}"], []

    def some(self, names):
        return [name for name in names if self.rng.random() < 0.4]

    def links(self, rows):
        return [self.chain.link_names[i] for i in rows]

    def make(self, operation):
        """Return the state after one change, the links that it leaves connected, and whether it is
        an impact."""
        chain, state, before, rng = self.chain, self.state, self.connected, self.rng
        every = range(len(chain.link_names))
        spare = [i for i in every if chain.topology.link_spare[i]]
        usable = [i for i in every if i not in spare or i in self.bound]
        if operation in ("connect", "here"):
            rows = self.some(usable)
            after = before | set(rows)
            state = svkc.connect(chain, state, *self.links(rows), here=operation == "here")
            return state, after, after > before
        if operation == "transition":
            after = set(self.some(usable))
            state = svkc.transition(chain, state, np.isin(every, list(after)))
            return state, after, bool(after - before)
        if operation == "cut":
            rows = self.some(every)
            return svkc.cut(chain, state, *self.links(rows)), before - set(rows), False
        if operation in ("lock", "unlock"):
            joints = self.some(chain.joint_names)
            state = getattr(svkc, operation)(chain, state, *joints)
            return state, before, operation == "lock" and bool(joints)
        if operation == "unbind":
            rows = self.some(spare)
            self.bound -= set(rows)
            return svkc.unbind(chain, state, *self.links(rows)), before - set(rows), False
        free = [i for i in spare if i not in before]
        if free:
            ends = [str(b) for b in rng.choice(chain.body_names, 2, replace=False)]
            state = svkc.bind(
                chain, state, chain.link_names[free[0]], *ends, joint=str(rng.choice(JOINTS)),
                axis=rng.normal(size=3), pos=rng.normal(size=3), real_pos=0.2 * rng.normal(size=3),
            )  # fmt: skip
            self.bound.add(free[0])
        return state, before, False

    def run(self, count):
        """Make some changes, and check each."""
        for _ in range(count):
            operation, before = str(self.rng.choice(OPERATIONS)), self.state
            self.log.append(operation)
            try:
                self.state, self.connected, impact = self.make(operation)
            except ValueError as error:
                # bodies that are not in place are refused; no other change may be
                if "away from where" not in str(error) and "cannot be closed" not in str(error):
                    raise
                continue
            violations = self.state_violations()
            if impact:
                violations |= self.impact_violations(before, operation == "here")
            elif not all(
                np.array_equal(x, y)
                for x, y in ((before.q, self.state.q), (before.v, self.state.v))
            ):
                violations["moved"] = 2
            if violations := {key: x for key, x in violations.items() if not x <= 1}:
                self.wrong.append((list(self.log), violations))

    def state_violations(self):
        """Return deviations of the state, of which those above 1 are wrong."""
        chain, state, bodies = self.chain, self.state, self.bodies
        s, q, v = (
            rigid_bodies.batched(state.structure),
            *(np.asarray(x)[None] for x in (state.q, state.v)),
        )
        gap, J = bodies.loops(s, q)
        connected = set(np.flatnonzero(s.connected[0]).tolist())
        out = {"structure": 2 * (connected != self.connected), "gap": np.abs(gap).max() / 3e-9}
        speed = 1 + np.abs(v).max()
        out["gap rate"] = np.abs(J @ v[:, None, :, None]).max() / (1e-8 * speed)
        energy = bodies.kinetic_energy(q, v) + bodies.potential_energy(s, q)
        out["energy"] = abs(float(svkc.energy(chain, state)) - energy[0]) / 1e-9 / speed**2
        for name, own, other in zip(
            ("momentum", "angular momentum"),
            svkc.momentum(chain, state),
            bodies.momentum(q, v),
            strict=True,
        ):
            out[name] = np.abs(np.asarray(own) - other[0].sum(0)).max() / 1e-9 / speed
        basis, clear = bodies.motions(s, q)
        if clear[0]:
            freedoms = np.any(basis[0], 0).sum()
            out["mobility"] = 2 * (int(svkc.mobility(chain, state).freedoms) != freedoms)
            tau = self.rng.normal(size=chain.dofs)
            own = np.asarray(svkc.forward_dynamics(chain, state, jnp.asarray(tau)))
            other = bodies.acceleration(s, q, v, tau[None])[0][0]
            off = np.abs((own - other) * bodies.active(s)[0]).max()
            out["acceleration"] = off / (1e-6 * (1 + np.abs(other).max()))
        return out

    def impact_violations(self, before, here):
        """Return deviations of the impact, of which those above 1 are wrong: velocity, energy lost
        (also by Carnot's theorem), and balance of momentum with the impulses."""
        chain, bodies, after = self.chain, self.bodies, rigid_bodies.batched(self.state.structure)
        q, v = np.asarray(self.state.q)[None], np.asarray(self.state.v)[None]
        active = bodies.active(rigid_bodies.batched(before.structure))
        v_before = np.where(active, np.asarray(before.v)[None], 0)
        expected, clear = bodies.after_impact(after, q, v_before)
        if not clear[0]:
            return {}
        now, change = bodies.active(after)[0], v - v_before
        tree = np.arange(chain.dofs) < chain.nv
        moved = bodies.change(np.asarray(before.q)[None], q)[0] * tree
        lost = bodies.kinetic_energy(q, v_before) - bodies.kinetic_energy(q, v)
        carnot = bodies.kinetic_energy(q, change * tree)
        names = np.isin(range(len(chain.link_names)), list(self.connected))
        record = change_structure(
            chain, before, self.state.structure.connected, self.state.structure.locked,
            jnp.asarray(names) if here else None,
        )  # fmt: skip
        impulse = np.concatenate([record.angular_impulse, record.impulse], 1)
        unbalanced = bodies.mass_matrix(q)[0] @ change[0]
        unbalanced += np.einsum("lij,li->j", bodies.loops(after, q)[1][0], impulse)
        size = 1 + np.abs(v_before).max()
        return {
            "tree moved": np.abs(moved).max() / 3e-8,
            "impact": np.abs((expected - v) * now).max() / (1e-7 * size),
            "carnot": abs(lost - carnot)[0] / (1e-8 * size**2),
            "energy lost": abs(float(record.energy_lost) - lost[0]) / (1e-8 * size**2),
            "impulse": np.abs(unbalanced * now).max() / (1e-7 * (size + np.abs(impulse).max())),
        }


def check(name, count):
    wrong = []
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        for seed in mechanisms.seeds(count):
            changes = Changes(name, seed)
            changes.run(6)
            wrong += changes.wrong
    assert not wrong


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cuttable", "assembly"])
def test_changes_of_structure(name):
    check(name, 10)
