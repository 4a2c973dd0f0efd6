"""Derivatives of the equations of motion in closed form against automatic differentiation."""

import dataclasses

import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest

import svkc
from svkc.optimize.closed_forms import StageDerivatives
from svkc.optimize.controls import Torques
from svkc.optimize.equations import (
    IntervalData,
    Model,
    Params,
    connection,
    stage_equations,
)
from svkc.optimize.lift import Layout, motion_hessian_pattern
from svkc.optimize.loop_rows import LinkRows
from svkc.optimize.motion_block import CLOSED_FORMS
from svkc.optimize.structures import candidate_rows

# an issue of sums in another order
ROUND_OFF = 1e-12
OTHER = (
    '<body name="other" pos="0.3 0.2 0.1"><joint name="s" type="slide" axis="0.3 1 0.2"/>{0}<body'
    ' name="last" pos="0.1 0.3 0.2"><joint name="h" axis="0.3 -1 0.2" range="-0.1 0.1"'
    ' armature="0.2" stiffness="3" damping="0.4"/>{0}</body></body></worldbody>'
)
BODY = '<inertial pos="0.1 0 0.2" mass="1.3" fullinertia="0.3 0.4 0.5 0.01 0.02 0.03"/>'
PLACES = {"pos": (0.4, 0.1, 0), "real_pos": (-0.6, 0.1, 0), "axis": (0.2, 0.5, 1)}


def linked_trees(joint: str, parent: str, real: str) -> svkc.Chain:
    """Return two trees of hinges and slides, with springs and ranges, and a virtual link."""
    text = models.random_tree(5, seed=3, kinds=("hinge", "slide"))
    text = text.replace("</worldbody>", OTHER.format(BODY))
    return svkc.load(text, virtual_links=[svkc.VirtualLink("grip", parent, real, joint, **PLACES)])


LINKS = pytest.mark.parametrize(
    ("joint", "parent", "real"),
    [
        ("weld", "b5", "last"),
        ("hinge", "last", "b4"),
        ("universal", "b5", "last"),
        ("ball", "world", "b5"),
        ("slide", "b3", "last"),
    ],
)


def equations_of(chain: svkc.Chain) -> tuple[Model, Params, IntervalData]:
    """Return the static part, the parameters and the data of equations with a chain's only link."""
    table = LinkRows.of(chain, candidate_rows(chain, np.array([True])))
    controls = Torques().for_chain(chain)
    layout = Layout(
        nv=chain.nv,
        stages=2,
        rows=len(table),
        control=controls.count(chain),
        blocks=2,
        stage_blocks=1,
    )
    active = np.ones(len(table), bool)
    data = IntervalData(
        reference=jnp.zeros(chain.nq), next_reference=jnp.zeros(chain.nq), active=active,
        structure=chain.state(connected=()).structure,
    )  # fmt: skip
    return Model(layout, table, controls), Params(chain, None), data


def close(x, y, scale=None):
    """Check that two arrays differ by round-off of the largest entry of y, or of `scale`."""
    scale = np.abs(y if scale is None else scale).max()
    np.testing.assert_allclose(x, y, rtol=0, atol=ROUND_OFF * scale)


@pytest.mark.slow
@LINKS
def test_derivatives_of_a_stage(joint, parent, real):
    """First derivatives and those of a sum of all rows, in every variable of the stage."""
    chain, random = linked_trees(joint, parent, real), np.random.default_rng(0)
    model, params, data = equations_of(chain)
    layout, table = model.layout, model.rows
    y = jnp.asarray(random.normal(size=layout.stage_size))
    multipliers = jnp.asarray(random.normal(size=chain.nv + len(table)))
    rows = lambda y: stage_equations(model, params, data, 1.0, y)

    @jax.jit
    def both(y):
        own = StageDerivatives(model, params, data, y)
        gradient = jax.grad(lambda y: rows(y) @ multipliers)
        by_autodiff = jax.jacfwd(rows)(y), gradient(y), jax.jacfwd(gradient)(y)
        return own.jacobian(), own.hessian(multipliers), by_autodiff

    J, (of_motion, of_controls, blocks, by_f), (J_ad, gradient, H) = both(y)
    nv, n = chain.nv, len(table)

    close(J, J_ad)
    close(np.concatenate([of_motion.ravel(), of_controls.ravel()]), gradient[2:-n])
    qq, qv, vv, qa = blocks
    zero = np.zeros((nv, nv))
    close(
        np.block([[qq, qv, qa], [qv.T, vv, zero], [qa.T, zero, zero]]),
        H[2:, 2:][: 3 * nv, : 3 * nv],
    )
    expected = np.zeros((n, layout.stage_size))
    expected[:, 2 : 2 + nv] = by_f
    close(expected[:, :-n], H[-n:, :-n], scale=H)
    assert not np.any(H[-n:, -n:])


@pytest.mark.slow
@pytest.mark.parametrize("function", CLOSED_FORMS)
@LINKS
def test_derivatives_of_a_node(function, joint, parent, real):
    """First derivatives of a connection and of a projection, and those of a sum of all rows."""
    chain, random = linked_trees(joint, parent, real), np.random.default_rng(1)
    model, params, data = equations_of(chain)
    # one row is not a constraint in the phase
    data = dataclasses.replace(data, active=np.arange(len(model.rows)) > 0)
    nv, n = chain.nv, len(model.rows)
    y = jnp.asarray(random.normal(size=3 * nv + n if function is connection else 2 * nv + 2 * n))
    multipliers = jnp.asarray(
        random.normal(size=(nv if function is connection else 2 * nv) + 2 * n)
    )
    rows = lambda y: function(model, params, data, y)

    @jax.jit
    def both(y):
        own = CLOSED_FORMS[function](model, params, data, y)
        by_autodiff = jax.jacfwd(rows)(y), jax.hessian(lambda y: rows(y) @ multipliers)(y)
        return own.jacobian(), own.hessian(multipliers), by_autodiff

    J, H, (J_ad, H_ad) = both(y)
    close(J, J_ad)
    close(H, H_ad)


def test_entries_of_the_hessian_are_there_once():
    """Of two symmetric entries there is one, as the solver adds what has one place."""
    layout = Layout(nv=3, stages=2, rows=2, control=2, blocks=2, stage_blocks=2)
    pairs = np.sort(np.stack(motion_hessian_pattern(layout), 1), 1)
    assert len(np.unique(pairs, axis=0)) == len(pairs)
