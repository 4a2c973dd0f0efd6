"""The choice of independent coordinates theta_G changes no acceleration and no motion."""

import itertools

import cases
import equinox as eqx
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from tolerances import REFERENCE

import svkc
from svkc.scenes.two_links import two_links


@pytest.mark.parametrize("name", cases.params("loops"))
def test_the_choice_of_coordinates_does_not_matter(name):
    """Preferring the dependent coordinates changes theta_G but not the acceleration."""
    chain, state, tau = cases.CASES[name].random_motion()
    first = svkc.coordinates(chain, state)
    other_state = eqx.tree_at(
        lambda s: s.structure.independent, state, first.dependent, is_leaf=lambda x: x is None
    )
    second = svkc.coordinates(chain, other_state)
    assert bool(jnp.any(first.independent != second.independent))
    a, b = svkc.forward_dynamics(chain, state, tau), svkc.forward_dynamics(chain, other_state, tau)
    np.testing.assert_allclose(a, b, rtol=0, atol=REFERENCE * float(jnp.max(jnp.abs(a))))


def four_bar():
    chain = models.four_bar()
    return chain, chain.state(v={"crank": 4.0})


def free_links():
    chain, _ = two_links()
    return chain, chain.state(v={"base": [0.9, 0, 0, 0, 0, 0.2], "link1": 0.5})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "admissible", "n_simulated"),
    [
        (four_bar, [(0,), (1,), (2,), (3,)], 2),
        # of the 28 pairs only those of theta_1, theta_6, theta_7 and theta_8
        (free_links, list(itertools.combinations((0, 5, 6, 7), 2)), 6),
    ],
    ids=["four_bar", "two_links"],
)
def test_every_admissible_choice_gives_the_same_motion(scene, admissible, n_simulated):
    """Runs of 1 s on a four-bar and on the paper's two links end in the same state.

    Only the first `n_simulated` choices are simulated: the four-bar's rocker and pin come to rest
    on the way, where they cannot be independent.
    """
    chain, state = scene()
    admitted, states = [], []
    for choice in itertools.combinations(range(chain.dofs), len(admissible[0])):
        state_k = svkc.with_independent(chain, state, *(chain.dof_names[i] for i in choice))
        independent = tuple(np.flatnonzero(svkc.coordinates(chain, state_k).independent).tolist())
        assert set(independent) <= set(itertools.chain(*admissible))
        if independent == choice:
            admitted.append(choice)
            states.append(state_k)
    assert admitted == admissible
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *states[:n_simulated])
    final = jax.vmap(
        lambda s: svkc.simulate(chain, s, 1.0, rtol=1e-11, atol=1e-13, throw=False).final
    )(stacked)
    assert float(jnp.abs(final.q - final.q[:1]).max()) < REFERENCE
    assert float(jnp.abs(final.v - final.v[:1]).max()) < REFERENCE
