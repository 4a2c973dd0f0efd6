"""Open chains against MuJoCo, with every intermediate quantity along a trajectory.

The cases are random trees, models written by others, and one URDF.
"""

import cases
import jax
import jax.numpy as jnp
import models
import mujoco
import numpy as np
import pytest
from references import paper
from tolerances import REFERENCE, ROUND_OFF

import svkc
from svkc.loops.forward_dynamics import acceleration
from svkc.tree.configuration import configuration_derivative
from svkc.tree.kinematics import kinematics
from svkc.tree.mass_matrix import mass_matrix_unit_vectors

# MuJoCo warns so of gymnasium's half_cheetah.xml
pytestmark = pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass' is deprecated")


@pytest.fixture(params=cases.params("tree"), scope="module")
def run(request):
    """Return a chain, MuJoCo's model and data without constraints, and eight states.

    The states are those of MuJoCo's own motion under random torques.
    """
    chain = cases.CASES[request.param].build()
    model = chain.model.model
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model.opt.timestep, model.opt.integrator = 0.002, mujoco.mjtIntegrator.mjINT_RK4
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    data.qvel[:] = rng.normal(size=model.nv)
    states = []
    for _ in range(8):
        tau = 0.3 * rng.normal(size=model.nv)
        data.qfrc_applied[:] = tau
        mujoco.mj_step(model, data, 10)
        mujoco.mj_forward(model, data)
        states.append((data.qpos.copy(), data.qvel.copy(), tau))
    return chain, model, data, states


@jax.jit
def all_quantities(chain, state, tau):
    kin = kinematics(chain, state.q)
    position, quat = svkc.poses(chain, state)
    linear, angular = svkc.velocities(chain, state)
    vdot = svkc.forward_dynamics(chain, state, tau)
    return {
        "position": position,
        "quat": quat,
        "linear": linear,
        "angular": angular,
        "mass": svkc.mass_matrix(chain, state),
        "mass by unit vectors": mass_matrix_unit_vectors(chain, kin),
        "bias": svkc.bias_force(chain, state),
        "acceleration": vdot,
        "acceleration by unit vectors": paper.forward_dynamics_by_unit_vectors(chain, state, tau),
        "acceleration by composites": acceleration(
            chain, state.structure, state.q, state.v, tau, svkc.dynamics.CompositeBodies()
        ),
        "inverse": svkc.inverse_dynamics(chain, state, vdot),
        "kinetic": svkc.kinetic_energy(chain, state),
        "power": jax.jvp(
            lambda q, v: svkc.energy(chain, svkc.State(q, v, state.structure)),
            (state.q, state.v),
            (configuration_derivative(chain, state.q, state.v), vdot),
        )[1],
    }


def test_every_intermediate_quantity(run):
    chain, model, data, states = run
    for q, v, tau in states:
        data.qpos[:], data.qvel[:], data.qfrc_applied[:] = q, v, tau
        mujoco.mj_forward(model, data)
        M, twist = np.zeros((model.nv, model.nv)), np.zeros((model.nbody, 6))
        mujoco.mj_fullM(model, data, M)
        for body in range(model.nbody):
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, twist[body], 0)
        computed = all_quantities(chain, chain.state(q, v), jnp.asarray(tau))
        R = np.zeros((model.nbody, 9))
        for body in range(model.nbody):
            mujoco.mju_quat2Mat(R[body], np.asarray(computed["quat"])[body])
        damping = (
            data.qfrc_damper @ v
            if hasattr(data, "qfrc_damper")
            else -(model.dof_damping.ravel() * v) @ v
        )
        expected = {
            "position": data.xpos,
            "linear": twist[:, 3:],
            "angular": twist[:, :3],
            "mass": M,
            "mass by unit vectors": M,
            "bias": data.qfrc_bias,
            "acceleration": data.qacc,
            "acceleration by unit vectors": data.qacc,
            "acceleration by composites": data.qacc,
            "inverse": tau,
            "kinetic": v @ M @ v / 2,
            "power": tau @ v + damping,
        }
        np.testing.assert_allclose(R, data.xmat, atol=ROUND_OFF)
        for name, value in expected.items():
            scale = max(np.abs(value).max(), 1e-3)
            if name in ("inverse", "power"):
                # these are differences of larger terms, whose scale counts
                scale = max(scale, np.abs(data.qfrc_bias).max() * max(1, np.abs(v).max()))
            assert np.abs(np.asarray(computed[name]) - value).max() <= 1e-10 * scale, name


def test_integrate_and_difference_are_inverse():
    chain = cases.CASES["random_7"].build()
    rng = np.random.default_rng(0)
    q, dv = chain.state().q, jnp.asarray(0.5 * rng.normal(size=chain.nv))
    np.testing.assert_allclose(
        svkc.difference(chain, q, svkc.integrate(chain, q, dv)), dv, atol=1e-13
    )
    _, rate = jax.jvp(lambda s: svkc.integrate(chain, q, s * dv), (0.0,), (1.0,))
    np.testing.assert_allclose(rate, configuration_derivative(chain, q, dv), atol=1e-13)


def test_open_chain_computes_no_loop_constraints():
    chain = cases.CASES["hopper"].build()
    text = str(jax.make_jaxpr(lambda s: svkc.forward_dynamics(chain, s, s.v))(chain.state()))
    for primitive in ("while", "scan", "argmax"):
        assert primitive not in text
    # the only solve is that with the mass matrix
    assert text.count("custom_linear_solve[") == 1


@pytest.mark.slow
@pytest.mark.parametrize("twigs", [0, 1, 6])
def test_deep_chain_agrees_with_mujoco(twigs):
    """Trees of 40 levels, too deep to be unrolled.

    They have no twigs, one on every third link, or several there, one of them on a ball joint.
    """
    xml, rod = "", '<geom type="capsule" fromto="0 0 0 0 0 -0.1" size="0.02" contype="0"/>'
    for i in range(40):
        for k in range(twigs if i % 3 == 1 else 0):
            joint, tip = (
                "ball" if k == 1 else "hinge",
                f'<body pos="0 0 -0.1"><joint axis="1 0 0"/>{rod}</body>',
            )
            xml += f'<body name="t{i}_{k}" pos="0 {k} 0"><joint type="{joint}"/>{rod}{tip}</body>'
        xml = (
            f'<body name="l{i}" pos="0 0 -0.1"><joint axis="{i % 2} {1 - i % 2}'
            f' 0"/>{rod}{xml}</body>'
        )
    chain = svkc.load(models.MJCF.format(xml))
    model = chain.model.model
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    data.qpos[:], data.qvel[:] = (
        data.qpos + 0.3 * rng.normal(size=model.nq),
        rng.normal(size=model.nv),
    )
    mujoco.mj_normalizeQuat(model, data.qpos)
    mujoco.mj_forward(model, data)
    state = chain.state(data.qpos, data.qvel)
    vdot = svkc.forward_dynamics(chain, state, jnp.zeros(model.nv))
    np.testing.assert_allclose(vdot, data.qacc, rtol=1e-8, atol=1e-8 * np.abs(data.qacc).max())
    crba_acceleration = acceleration(
        chain,
        state.structure,
        state.q,
        state.v,
        jnp.zeros(model.nv),
        svkc.dynamics.CompositeBodies(),
    )
    np.testing.assert_allclose(
        vdot, crba_acceleration, rtol=REFERENCE, atol=1e-10 * np.abs(data.qacc).max()
    )


@pytest.mark.slow
def test_derivatives_of_a_deep_chain():
    """Derivatives in both modes agree with finite differences, through loops over levels."""
    xml = ""
    for i in range(30):
        xml = (
            f'<body name="l{i}" pos="0 0 -0.1"><joint axis="{i % 2} {1 - i % 2} 0"/><geom'
            f' size="0.02" contype="0"/>{xml}</body>'
        )
    chain = svkc.load(models.MJCF.format(xml))
    q = jnp.asarray(np.random.default_rng(0).normal(size=30) * 0.3)
    out = svkc.check_grad(
        lambda q: jnp.sum(svkc.forward_dynamics(chain, chain.state(q), jnp.zeros(30))[:3]), q
    )
    assert out.error < 1e-7, out
