"""A number that is not finite is traced to its source."""

import re

import equinox as eqx
import error_page
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest

import svkc

NAN = np.nan
STEPS = {"dt": 5e-3}


@pytest.fixture(scope="module")
def arm():
    return svkc.load(models.MJCF.format(models.TWO_RODS).replace('damping="0"', 'damping="0.1"'))


def control(t, state, args):
    """Return torques; that of the second joint is `gain` from the time `until` on."""
    return jnp.stack([0.0 * t, jnp.where(t > args["until"], args["gain"], 0.0)])


def guard(t, state, args):
    return jnp.where(t > args["seen_until"], NAN, 1.0)


EVENTS = [svkc.at(5.0), svkc.when(guard, stop=True)]
ARGS = {"until": 9.0, "gain": NAN, "seen_until": 9.0}


def message(chain, state=None, args=(), **kw):
    """Return what follows "First: " in the error of a run that ends with a non-finite number."""
    state = chain.state({"upper": 0.5}) if state is None else state
    options = {"control": control, "events": EVENTS, "args": ARGS | dict(args)} | STEPS | kw
    with error_page.as_users_see(), pytest.raises(RuntimeError) as caught:
        svkc.simulate(chain, state, 0.02, **options)
    text, _, source = str(caught.value).partition(" First: ")
    assert text.endswith("A non-finite number appeared.")
    return source


@pytest.mark.slow
def test_the_control_is_named_with_its_joint_and_the_array_of_args(arm):
    expected = "the control: nan for 'lower' (args['gain'] is not finite), at t = {} s"
    assert message(arm, args={"until": 0.011}) == expected.format(0.0125)
    assert message(arm, args={"until": 0.010}) == expected.format(0.0125)
    # a control that is NaN from the start
    assert message(arm, args={"until": -1.0}) == expected.format(0)


@pytest.mark.slow
def test_the_guard_is_named_by_its_place_in_the_events(arm):
    source = message(arm, args={"seen_until": 0.011, "gain": 0.0})
    assert source == "the guard of events[1], at t = 0.0125 s"


@pytest.mark.parametrize(
    ("field", "row", "owner"),
    [("damping", 1, " of joint 'lower'"), ("com", 2, " of body 'lower'"), ("gravity", 0, "")],
)
def test_a_parameter_of_the_chain_is_named_with_its_joint_or_body(arm, field, row, owner):
    values = getattr(arm, field)
    chain = eqx.tree_at(lambda c: getattr(c, field), arm, values.at[row].set(NAN))
    assert message(chain) == f"chain.{field}{owner}"


def test_the_motion_and_a_singular_mass_matrix_are_named(arm):
    weights = arm.mass.at[2].set(0), arm.inertia.at[2].set(0)
    massless = eqx.tree_at(lambda c: (c.mass, c.inertia), arm, weights)
    singular = r"the acceleration of '\w+'; the mass matrix is singular, so a joint moves no mass"
    assert re.match(singular, message(massless))
    fast = arm.state({"upper": 0.5}, {"upper": 1e100})
    motion = "the motion itself, after t = 0 s; 'upper' moves at 1e+100 rad/s or m/s"
    assert message(arm, fast) == motion


def test_adaptive_steps(arm):
    source = message(arm, args={"until": 0.011}, dt=None, rtol=1e-6)
    assert re.match(r"the control: nan for 'lower' .*, at t = 0\.011\d* s", source)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["grad", "jvp"])
def test_the_source_is_named_inside_of_derivatives(arm, mode):
    """The control reads a traced value; a second one is passed as args."""

    def run(x):
        torques = lambda t, s, args: control(t, s, args) + x
        state = arm.state({"upper": 0.5})
        args = ARGS | {"until": 0.011, "gain": NAN * x}
        options = {"control": torques, "events": EVENTS, "args": args} | STEPS
        return svkc.simulate(arm, state, 0.02, **options).final.q[0]

    calls = {"grad": lambda: jax.grad(run)(0.5), "jvp": lambda: jax.jvp(run, (0.5,), (1.0,))}
    words = r"First: the control: nan for 'lower' \(args\['gain'\] is not finite\)"
    with error_page.as_users_see(), pytest.raises(RuntimeError, match=words):
        calls[mode]()


@pytest.mark.slow
def test_lanes_of_a_batch_are_named(arm):
    """With the data of each lane, after a compiled run; other results have no line."""
    lane = lambda chain, data: {
        "args": {"until": data[0], "gain": NAN, "seen_until": data[1]},
        "chain": eqx.tree_at(lambda c: c.damping, chain, chain.damping * data[2]),
    }
    data = jnp.array([[9, 9, 1.0], [0.011, 9, 1], [9, 0.011, 1], [9, 9, NAN], [9, 9, 1]])
    states = jax.tree.map(lambda x: jnp.stack([x] * len(data)), arm.state({"upper": 0.5}))
    states = eqx.tree_at(lambda s: s.q, states, states.q.at[4, 1].set(NAN))
    options = {"control": control, "events": EVENTS} | STEPS
    traj = svkc.rollout(arm, states, 0.02, lane=lane, data=data, progress=False, **options)
    lines = traj.trace_non_finite(arm, lane=lane, data=data, **options).splitlines()
    assert lines == [
        "lane 1: the control: nan for 'lower' (args['gain'] is not finite), at t = 0.0125 s",
        "lane 2: the guard of events[1] (args['gain'] is not finite), at t = 0.0125 s",
        "lane 3: chain.damping of joint 'lower'",
        "lane 4: q of joint 'lower' in the initial state",
    ]
    first = jax.tree.map(lambda x: x[0], traj)
    assert first.trace_non_finite(arm, args=ARGS, **options) == ""


@pytest.mark.slow
def test_placement_of_a_virtual_link_is_named():
    """A change of structure with a placement that is not finite."""
    four = models.four_bar()
    start = four.state(connected=())
    start = eqx.tree_at(lambda s: s.structure.pos, start, start.structure.pos * NAN)
    events = [svkc.at(1e-3, connect="pin")]
    with error_page.as_users_see(), pytest.raises(RuntimeError, match=r"state.structure.pos of"):
        svkc.simulate(four, start, 1e-3, events=events, dt=1e-3)
