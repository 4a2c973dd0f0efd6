"""`svkc.step` with joint damping: against MuJoCo, in loops, its programs and derivatives."""

import cases
import equinox as eqx
import jax
import jax.numpy as jnp
import models
import mujoco
import numpy as np
import pytest
from references import kkt
from tolerances import REFERENCE, ROUND_OFF

import svkc

pytestmark = pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass' is deprecated")

DAMPED = models.MJCF.format(
    models.bar(
        "a",
        'axis="0 1 0" armature="0.05" damping="0.4"',
        "0 0 -1",
        inside=models.bar("b", 'axis="0.3 1 0" stiffness="4" damping="0.7"', "0 0 -1", "0 0 -1"),
    )
)


def largest_difference_from_mj_step(chain, dt: float, eulerdamp: bool, steps: int = 50) -> float:
    """Return the largest difference of a step from MuJoCo's Euler, relative to the velocities, at
    the states of MuJoCo's own motion without limits and contacts."""
    model = chain.model.model
    flags = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    if not eulerdamp:
        flags |= int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    model.opt.disableflags, model.opt.timestep = flags, dt
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    chain = eqx.tree_at(
        lambda c: (c.limit, c.limit_spring), chain, (None, None), is_leaf=lambda x: x is None
    )
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    data.qvel[:], data.qfrc_applied[:] = rng.normal(size=(2, model.nv))
    step = jax.jit(lambda s: svkc.step(chain, s, data.qfrc_applied, dt, implicit_damping=eulerdamp))
    worst = 0.0
    for _ in range(steps):
        q, v = jnp.array(data.qpos), jnp.array(data.qvel)
        end = step(svkc.State(q, v, chain.structure))
        mujoco.mj_step(model, data)
        error = max(np.abs(end.q - data.qpos).max(), np.abs(end.v - data.qvel).max())
        worst = max(worst, float(error) / max(1.0, np.abs(data.qvel).max()))
    return worst


@pytest.mark.parametrize("eulerdamp", [True, False])
def test_a_step_of_the_cheetah_is_a_step_of_mujoco(eulerdamp):
    """Steps of 10 ms, which are the cheetah's own, with and without MuJoCo's implicit damping."""
    chain = cases.CASES["half_cheetah"].build()
    assert largest_difference_from_mj_step(chain, 0.01, eulerdamp) < ROUND_OFF


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hopper", "walker2d", "ant", "humanoid", "random_7", "random_25"])
def test_a_step_of_a_damped_tree_is_a_step_of_mujoco(name):
    """Figures of others, and trees of hinges, slides and balls with springs and armature."""
    assert largest_difference_from_mj_step(cases.CASES[name].build(), 0.005, True) < ROUND_OFF


def test_a_damper_is_stable_with_any_step():
    """A damper that is a thousand times too stiff for an explicit step stops its joint in one."""
    chain = svkc.load(models.MJCF.format(models.bar("a", 'axis="0 1 0" damping="1e4"', "0 0 -1")))
    state = chain.state(v={"a": 1.0})
    v = [
        float(svkc.step(chain, state, [0.0], 0.05, implicit_damping=i).v[0]) for i in (True, False)
    ]
    assert abs(v[0]) < 1e-2 < 100 < abs(v[1])


@pytest.fixture(scope="module")
def damped_four_bar():
    xml = models.MJCF.format(models.FOUR_BAR).replace('damping="0"', 'damping="5"')
    chain = svkc.load(xml, virtual_links=[models.pin()])
    return chain, chain.state(v={"crank": 4.0})


@pytest.mark.slow
def test_damping_of_a_closed_loop_enters_with_its_constraints(damped_four_bar):
    """The velocity's change is that of the loop with dt D on the diagonal of the mass matrix."""
    chain, state = damped_four_bar
    dt, tau = 0.02, jnp.array([1.0, -2.0, 0.5])
    end = svkc.step(chain, state, tau, dt)
    rotors = svkc.load(
        models.MJCF.format(models.FOUR_BAR).replace(
            'damping="0"', f'damping="5" armature="{dt * 5}"'
        ),
        virtual_links=[models.pin()],
    )
    expected = state.v[: chain.nv] + dt * kkt.constrained_acceleration(rotors, state, tau)
    np.testing.assert_allclose(end.v[: chain.nv], expected, atol=REFERENCE)
    explicit = svkc.step(chain, state, tau, dt, implicit_damping=False)
    assert float(jnp.abs(explicit.v - end.v).max()) > 0.1
    walk = lambda s: jax.lax.fori_loop(0, 200, lambda _, s: svkc.step(chain, s, tau, dt), s)
    assert float(jnp.abs(svkc.loop_gaps(chain, jax.jit(walk)(state))).max()) < 1e-3


def cuttable_case():
    """Return a damped double pendulum whose second joint can be cut, a state, and torques."""
    chain = svkc.load(DAMPED, cuttable="b")
    order = jnp.array([chain.dof_names.index(name) for name in "ab"])
    tau = jnp.zeros(chain.dofs).at[order].set(jnp.array([0.3, -0.2]))
    return chain, chain.state({"a": 0.4, "b": 0.5}, {"a": 1.0, "b": 20.0}), tau, order


@pytest.mark.slow
def test_damping_of_a_cuttable_joint_is_implicit():
    """A joint named in `cuttable=` moves as it does in the tree."""
    chain, state, tau, order = cuttable_case()
    end = svkc.step(chain, state, tau, 0.05)
    plain = svkc.load(DAMPED)
    same = svkc.State(jnp.array([0.4, 0.5]), jnp.array([1.0, 20.0]), plain.structure)
    in_tree = svkc.step(plain, same, tau[order], 0.05)
    np.testing.assert_allclose(end.v[order], in_tree.v, atol=REFERENCE)


@pytest.mark.slow
def test_damping_of_a_joint_that_is_cut_does_nothing():
    """The freed body's velocity, and that of the other body, are those without the damper."""
    chain, state, tau, order = cuttable_case()
    free = svkc.cut(chain, state, "b")
    undamped = eqx.tree_at(lambda c: c.damping, chain, chain.damping.at[order[1]].set(0.0))
    ends = [svkc.step(c, free, tau, 0.05).v[: chain.nv] for c in (chain, undamped)]
    np.testing.assert_allclose(*ends, atol=ROUND_OFF)


def test_undamped_models_compile_to_the_same_program():
    """Without damping `implicit_damping` adds no operation; with damping one of two operands."""

    def program(chain, **options):
        step = lambda s: svkc.step(chain, s, jnp.zeros(chain.nv), 1e-2, **options)
        return str(jax.make_jaxpr(step)(chain.state()))

    for chain in (svkc.load(models.MJCF.format(models.TWO_RODS)), models.four_bar()):
        assert chain.damping is None
        assert program(chain) == program(chain, implicit_damping=False)
    damped = svkc.load(DAMPED)
    assert program(damped) != program(damped, implicit_damping=False)


@pytest.mark.parametrize("cuttable", [(), pytest.param("b", marks=pytest.mark.slow)])
def test_derivatives_by_damping(cuttable):
    """A step's derivatives by the dampings, a zero one included, equal differences both ways."""
    chain = svkc.load(DAMPED, cuttable=cuttable)
    state = chain.state({"a": 0.4, "b": 0.5}, {"a": 1.0, "b": 3.0})

    def stepped(x):
        damped = eqx.tree_at(lambda c: c.damping, chain, x["damping"])
        end = svkc.step(damped, svkc.State(x["q"], x["v"], state.structure), x["tau"], 0.02)
        return {"q": end.q, "v": end.v}

    tau = jnp.sin(jnp.arange(1.0, 1 + chain.dofs))
    x = {"damping": chain.damping.at[0].set(0.0), "q": state.q, "v": state.v, "tau": tau}
    check = svkc.check_grad(stepped, x, directions=1)
    assert max(check.error, check.modes) < 1e-8, check
