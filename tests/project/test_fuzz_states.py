"""Random calls of `chain.state`, checked by laws in numpy that share no code with svkc.

A sample is a number: the seed of its geometry, masses, names and values. `SVKC_FUZZ=1000 python -m
pytest tests/project/test_fuzz_states.py -m slow -n 0` tries a thousand new ones of each mechanism.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import mechanisms
import numpy as np
import pytest
import state_laws
from references import rigid_bodies

import svkc
from svkc.model.names import q_slice, v_slice


class Call:
    """A random call of `chain.state`, and what its result must have."""

    def __init__(self, name, seed):
        self.label, rng = f"{name}, seed {seed}", np.random.default_rng(seed)
        self.sample = sample = mechanisms.sample(name, rng, rng.choice([0.05, 0.4]))
        self.chain = chain = sample.chain
        self.structure = mechanisms.random_structure(chain, rng)
        basis = sample.bodies.motions(rigid_bodies.batched(self.structure), sample.q[None])[0]
        v = basis[0] @ rng.normal(size=chain.dofs) * rng.choice([0.1, 1, 10])
        step = rng.choice([0, 1e-9, 1e-3, 0.1])
        moved = sample.bodies.move(sample.q[None], step * rng.normal(size=(1, chain.dofs)))
        self.target, self.exact = moved[0], step == 0
        self.v = v + rng.choice([0, 1.0], p=[0.7, 0.3]) * rng.normal(size=chain.dofs)
        self.none = np.zeros(chain.dofs, bool)
        self.named_q = self.named_v = self.none
        self.q_argument, self.v_argument, self.hold = self.target, self.v, None
        self.start, self.fixed, self.v_before = self.target, False, self.v
        if rng.random() < 0.75:
            self.name_some(rng)
        elif rng.random() < 0.3:
            self.hold, self.named_q, self.named_v = True, ~self.none, ~self.none
        if self.q_argument is self.target:
            # an array gives the poses of bodies; joints that may be cut are where these say
            self.start = mechanisms.with_cuttable_joints(sample, self.structure, self.target)

    def name_some(self, rng):
        """Give random joints by name."""
        chain, top, fixed = self.chain, self.chain.topology, rng.random() < 0.9
        names = list(chain.joint_names) + [name for name, *_ in top.cuttable_joints]
        self.named_q, self.named_v = self.none.copy(), self.none.copy()
        self.q_argument, self.v_argument, requested = {}, {}, self.sample.q.copy()
        for name in rng.permutation(names)[: rng.integers(0, len(names) + 1)]:
            at = q_slice(top, name)
            self.q_argument[str(name)] = requested[at] = self.target[at]
            self.named_q[v_slice(top, name)] = True
        for name in rng.permutation(names)[: rng.integers(0, len(names) + 1)]:
            at = v_slice(top, name)
            self.v_argument[str(name)], self.named_v[at] = self.v[at], True
        self.v_before = np.where(self.named_v, self.v, 0)
        self.start, self.fixed = (self.sample.q, True) if fixed else (requested, False)
        if not fixed:
            self.hold, self.named_q, self.named_v = False, self.none, self.none

    def __call__(self):
        near = svkc.State(jnp.asarray(self.sample.q), jnp.zeros(self.chain.dofs), self.structure)
        return self.chain.state(
            self.q_argument, self.v_argument, near=near, hold=self.hold, throw=False
        )

    def violations(self, state):
        """Return what is wrong with a result: {} if nothing is."""
        if not np.isfinite(np.asarray(state.q)).all():
            # the sample's own coordinates close the loops, and no velocity contradicts them
            return {"refused": 1} if self.exact and not self.named_v.any() else {}
        return state_laws.violations(
            self.sample,
            state,
            start=self.start,
            v_before=self.v_before,
            named_q=self.named_q,
            named_v=self.named_v,
            target=self.target,
            v_target=self.v,
            fixed_q=self.fixed,
        )


def check(name, count):
    """Check random calls; list all wrong ones. At least a third must have a result."""
    wrong, results = [], 0
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        for seed in mechanisms.seeds(count):
            call = Call(name, seed)
            state = call()
            results += bool(np.isfinite(np.asarray(state.q)).all())
            if violations := call.violations(state):
                wrong.append((call.label, violations))
    assert not wrong
    assert results > len(mechanisms.seeds(count)) / 3


@pytest.mark.slow
def test_states_of_a_planar_loop():
    check("four-bar", 40)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["spatial", "joints", "cuttable"])
def test_states_of_loops_of_all_joints(name):
    check(name, 40)


@pytest.mark.slow
@pytest.mark.parametrize("poison", ["q", "mass", "place", "unreachable"])
def test_a_poisoned_lane_leaves_the_others_bit_for_bit(poison):
    """States of a batch in which one lane has NaN, a negative mass or an unreachable target."""
    lanes = [mechanisms.sample("four-bar", np.random.default_rng(i), 0.2) for i in range(4)]
    chains, q = jax.tree.map(lambda *x: jnp.stack(x), *((s.chain, jnp.asarray(s.q)) for s in lanes))

    @jax.jit
    @jax.vmap
    def states(chain, q, target):
        near = svkc.State(q, jnp.zeros(chain.dofs), chain.structure)
        state = chain.state({"crank": target}, {"crank": 1.0}, near=near, throw=False)
        return state.q, state.v

    clean = states(chains, q, q[:, 0] + 0.01)
    target = q[:, 0] + 0.01
    if poison == "q":
        q = q.at[1].set(jnp.nan)
    elif poison == "mass":
        chains = eqx.tree_at(lambda c: c.mass, chains, chains.mass.at[1].set(-1.0))
    elif poison == "place":
        place = chains.structure.pos.at[1].set(jnp.nan)
        chains = eqx.tree_at(lambda c: c.structure.pos, chains, place)
    else:
        # the pin at a distance that the bars do not reach
        place = chains.structure.pos.at[1].set(20.0)
        chains = eqx.tree_at(lambda c: c.structure.pos, chains, place)
    poisoned = states(chains, q, target)
    for before, after in zip(clean, poisoned, strict=True):
        np.testing.assert_array_equal(np.asarray(before)[[0, 2, 3]], np.asarray(after)[[0, 2, 3]])
    assert np.isfinite(np.asarray(clean[0])).all()
    assert np.isnan(np.asarray(poisoned[0])[1]).all() == (poison != "mass")
