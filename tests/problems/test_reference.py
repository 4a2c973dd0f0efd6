"""Published problems with independent solutions."""

import os
import pathlib
import subprocess
import sys

import diffrax
import jax
import jax.numpy as jnp
import maximal
import numpy as np
import pytest
from reference_problems import (
    TOP_MJCF,
    body_positions,
    load_reference,
    n_four_bar,
    numbers,
    spring_control,
    tight_tolerances,
)
from tolerances import REFERENCE, ROUND_OFF

import svkc


def align_quaternion_signs(q, expected):
    """Return two arrays of quaternions, the first with the signs of the second."""
    q, expected = np.asarray(q), np.asarray(expected)
    return q * np.sign(np.sum(q * expected, 1))[:, None], expected


@pytest.mark.parametrize("case", load_reference("free_top")["cases"], ids=lambda case: case["name"])
def test_free_top(case):
    """Orientation and rates agree to 1e-9, or to the round-off that the motion amplifies.

    Each step may round the rates by 2^-52 of the largest rate. The bound is three standard
    deviations of the sum of these errors, each amplified by the motion from its time to the end.
    """
    chain = svkc.load(TOP_MJCF.format("0 0 0", "0 0 0", 1, numbers(case["inertia"])))
    traj = svkc.simulate(
        chain,
        chain.state(v={"top": case["omega0_body"]}),
        case["t_end"],
        ts=jnp.array(case["t"]),
        **tight_tolerances(1e-13),
    )
    steps = int(traj.report().accepted) / (len(case["t"]) - 1)
    deviation = 2.0**-52 * np.sqrt(steps * np.sum(np.square(case["amplification"])))
    bound = max(1e-9, 3 * deviation)
    np.testing.assert_allclose(
        *align_quaternion_signs(traj.states.q, case["quat_wxyz_body_to_world"]), atol=bound
    )
    np.testing.assert_allclose(
        traj.states.v, case["omega_body"], atol=3 * bound * np.max(np.abs(case["omega_body"]))
    )


@pytest.mark.parametrize(
    "case", load_reference("heavy_top")["cases"], ids=lambda case: case["name"]
)
def test_heavy_top(case):
    """Orientations agree with the reference."""
    model = load_reference("heavy_top")["model"]
    chain = svkc.load(
        TOP_MJCF.format(
            numbers(model["gravity"]),
            numbers(model["com_body"]),
            model["mass"],
            numbers(model["inertia_com_body"]),
        )
    )
    traj = svkc.simulate(
        chain,
        chain.state(v={"top": case["omega0_body"]}),
        case["t_end"],
        ts=jnp.array(case["t"]),
        **tight_tolerances(1e-13),
    )
    np.testing.assert_allclose(
        *align_quaternion_signs(traj.states.q, case["quat_wxyz_body_to_world"]), atol=REFERENCE
    )


# the largest error of the angles at each tolerance
ERROR_AT = {1e-9: 1e-5, 1e-12: 1e-8}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("windows", "tolerances"), [(1, [1e-9, 1e-12]), (2, [1e-9, 1e-12]), (5, [1e-9])]
)
def test_n_four_bar_through_its_singular_configurations(windows, tolerances):
    """Angle, energy and loops of 10 s (two windows: 20 s) with some forty drops of the rank.

    The dependent coordinates change on the way.
    """
    case = next(case for case in load_reference("n_four_bar")["cases"] if case["N"] == windows)
    chain, state = maximal.load(n_four_bar(windows))
    ts = jnp.array([*case["t"], 20.0] if windows == 2 else case["t"])
    run = jax.jit(
        lambda state, tolerance: svkc.simulate(
            chain, state, ts[-1], ts=ts, **tight_tolerances(tolerance)
        )
    )
    for tolerance in tolerances:
        traj = run(state, tolerance)
        positions = 2 * body_positions(chain, traj, "vert0")[: len(case["t"]), :2]
        np.testing.assert_allclose(positions, case["B0"], atol=ERROR_AT[tolerance])
        energy = jax.vmap(lambda s: svkc.energy(chain, s))(traj.states)
        assert np.max(np.abs(energy - energy[0])) <= 1e-6 * case["energy"]
        assert np.max(traj.gaps) < ROUND_OFF
        dependent = np.asarray(
            jax.vmap(lambda s: svkc.coordinates(chain, s).dependent)(traj.states)
        )
        assert len(np.unique(dependent, axis=0)) > 1


def forty_windows():
    """Simulate 20 s of forty windows through all their singular configurations."""
    case = next(case for case in load_reference("n_four_bar")["cases"] if case["N"] == 40)
    chain, state = maximal.load(n_four_bar(40))
    assert svkc.mobility(chain, state).freedoms == 1
    traj = svkc.simulate(
        chain,
        state,
        20.0,
        ts=jnp.array([0.0, 1.0, 20.0]),
        dynamics=svkc.dynamics.CompositeBodies(hold=None),
        **tight_tolerances(1e-8),
    )
    np.testing.assert_allclose(
        2 * body_positions(chain, traj, "vert0")[1, :2], case["B0"][1], atol=1e-6
    )
    assert abs(float(traj.report().energy_drift)) <= 1e-6 * case["energy"]
    assert int(traj.report().swaps) > 0
    assert np.max(traj.gaps) < ROUND_OFF


@pytest.mark.slow
def test_n_four_bar_of_forty_windows():
    """Forty windows, in a process whose XLA programs are optimized.

    Without optimization the run takes eight minutes.
    """
    flags = os.environ["XLA_FLAGS"].replace("--xla_backend_optimization_level=0", "")
    tests = pathlib.Path(__file__).parents[1]
    paths = os.pathsep.join(map(str, (tests, tests / "references")))
    env = os.environ | {"XLA_FLAGS": flags, "JAX_ENABLE_X64": "1", "PYTHONPATH": paths}
    code = "import test_reference; test_reference.forty_windows()"
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=pathlib.Path(__file__).parent,
        env=env,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_andrews_mechanism():
    """Every angle and rate over 0.05 s agree; at 0.03 s the published digits, to 1e-8."""
    reference = load_reference("andrews")
    chain, state = maximal.load(reference["problem"])
    traj = svkc.simulate(
        chain,
        state,
        0.05,
        ts=jnp.array(reference["t"]),
        control=spring_control(chain, reference["problem"]),
        **tight_tolerances(1e-12),
    )
    # Absolute angles: beta of K1, gamma of K3, delta of K5, epsilon of K7. Relative angles: Theta
    # of K2 on K1, Phi of K4 on K5, Omega of K6 on K7.
    bodies_of_angle = {
        "beta": ("K1",),
        "gamma": ("K1", "K2", "K3"),
        "delta": ("K1", "K2", "K4", "K5"),
        "epsilon": ("K1", "K2", "K6", "K7"),
        "Theta": ("K2",),
    }
    bodies_of_angle |= {"Phi": ("K5",), "Omega": ("K7",)}
    signs = {"Phi": -1, "Omega": -1}
    index = {
        name: [chain.dof_names.index(body) for body in bodies]
        for name, bodies in bodies_of_angle.items()
    }
    for i, name in enumerate(reference["angles"]):
        sign = signs.get(name, 1)
        angle = reference["q0"][i] + sign * np.sum(np.asarray(traj.states.q)[:, index[name]], 1)
        rate = sign * np.sum(np.asarray(traj.states.v)[:, index[name]], 1)
        np.testing.assert_allclose(angle, np.array(reference["q"])[:, i], atol=1e-10)
        np.testing.assert_allclose(
            rate, np.array(reference["v"])[:, i], atol=1e-8 * np.max(np.abs(reference["v"]))
        )
        published = int(np.argmin(np.abs(np.array(reference["t"]) - 0.03)))
        assert angle[published] == pytest.approx(float(reference["at_0p03"]["q"][i]), rel=1e-8)
        assert rate[published] == pytest.approx(float(reference["at_0p03"]["v"][i]), rel=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(
    "variant", load_reference("slider_crank_3d")["variants"], ids=lambda variant: variant["name"]
)
def test_slider_crank_3d(variant):
    """Position and velocity of the slider agree with the reference over 5 s."""
    chain, state = maximal.load(variant["problem"])
    traj = svkc.simulate(chain, state, 5.0, ts=jnp.array(variant["t"]), **tight_tolerances(1e-12))
    np.testing.assert_allclose(
        body_positions(chain, traj, "slider")[:, 0], variant["slider_x"], atol=1e-10
    )
    np.testing.assert_allclose(
        traj.states.v[:, chain.dof_names.index("slider")], variant["slider_v"], atol=REFERENCE
    )


@pytest.mark.slow
def test_rssr_motion_is_independent_of_the_idle_spin():
    """A coupler that spins at 200 rad/s about its own axis does not change the motion."""
    crank_velocities = []
    for variant in load_reference("rssr")["variants"]:
        chain, state = maximal.load(variant["problem"])
        traj = svkc.simulate(
            chain, state, 4.0, ts=jnp.array(variant["t"]), **tight_tolerances(1e-12)
        )
        np.testing.assert_allclose(
            body_positions(chain, traj, "coupler"), variant["coupler_com"], atol=REFERENCE
        )
        np.testing.assert_allclose(
            traj.states.v[:, chain.dof_names.index("crank")], variant["crank_rate"], atol=1e-8
        )
        crank_velocities.append(np.asarray(traj.states.v[:, 0]))
    np.testing.assert_allclose(*crank_velocities, atol=1e-8)


CART = (
    '<mujoco><compiler balanceinertia="false"/><option gravity="0 0 -9.81"/><worldbody><body'
    ' name="cart"><joint name="x" type="slide" axis="1 0 0"/><inertial pos="0 0 0" mass="{}"'
    ' diaginertia="1e-12 1e-12 1e-12"/><body name="pole"><joint name="theta" type="hinge" axis="0'
    ' -1 0"/><inertial pos="0 0 -1" mass="1" diaginertia="1e-15 1e-15'
    ' 1e-15"/></body></body></worldbody></mujoco>'
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "tolerance", "error"), [(0, 1e-11, 1e-8), (1, 1e-13, 1e-10), (2, 1e-9, 1e-5)]
)
def test_light_cartpole(number, tolerance, error):
    """Carts of 1e-6, 1e-3 and 1e-9 of the pole: rates of 4e3, 1e2 and 1e5 rad/s in each swing."""
    case = load_reference("light_cartpole")["cases"][number]
    chain = svkc.load(CART.format(case["M"]))
    traj = svkc.simulate(
        chain,
        chain.state({"theta": np.pi / 2}),
        10.0,
        ts=jnp.array(case["t"]),
        **tight_tolerances(tolerance),
    )
    np.testing.assert_allclose(traj.states.q[:, 0], case["x"], atol=error)
    np.testing.assert_allclose(traj.states.q[:, 1], case["theta"], atol=error)


@pytest.mark.slow
def test_slider_crank_with_gradients():
    """SUNDIALS' slider-crank: path, integral of the kinetic energy, and its gradient.

    The gradient is by the spring's stiffness and the damper's constant.
    """
    reference = load_reference("sundials_slider_crank")
    crank = (
        '<body name="crank"><joint name="crank" axis="0 0 1"/><inertial pos="0 0 0" mass="1"'
        ' diaginertia="1 1 1"/></body>'
    )
    rod = (
        '<body name="rod"><joint name="x" type="slide" axis="1 0 0"/><joint name="rod" axis="0 0'
        ' 1"/>'
    )
    rod += '<inertial pos="0 0 0" mass="1" diaginertia="2 2 2"/></body>'
    pin = svkc.VirtualLink(
        "pin", "crank", "rod", "hinge", pos=(0.5, 0, 0), real_pos=(-1, 0, 0), connected=True
    )
    chain = svkc.load(
        f'<mujoco><option gravity="0 0 0"/><worldbody>{crank}{rod}</worldbody></mujoco>',
        virtual_links=[pin],
    )
    state = chain.state({"crank": np.pi / 2, "x": np.sqrt(0.75), "rod": -np.pi / 6})

    def points(q):
        """Return the spring's two ends and the end of the rod that the force acts on."""
        crank, x, rod = q[0], q[1], q[2]
        tip, slider = 0.5 * jnp.stack([jnp.cos(crank), jnp.sin(crank)]), jnp.stack([x, 0 * x])
        direction = jnp.stack([jnp.cos(rod), jnp.sin(rod)])
        return tip / 2, slider - direction / 2, slider + direction

    def control(t, state, args):
        (one, other, _), pull_back = jax.vjp(points, state.q)
        rates = jax.jvp(points, (state.q,), (state.v,))[1]
        separation, separation_rate = other - one, rates[1] - rates[0]
        length = jnp.linalg.norm(separation)
        force = (
            (args[0] * (length - 1) + args[1] * (separation @ separation_rate) / length)
            * separation
            / length
        )
        return pull_back((force, -force, jnp.array([1.0, 0.0])))[0]

    # Gauss-Legendre nodes of 40 intervals
    node, weight = np.polynomial.legendre.leggauss(8)
    nodes = (np.arange(40)[:, None] + (node + 1) / 2).ravel() / 4

    args, expected = jnp.ones(2), reference["functional"]
    ts = np.concatenate([nodes, reference["t"]])
    order = np.argsort(ts, kind="stable")

    def functional(args):
        traj = svkc.simulate(
            chain,
            state,
            10.0,
            ts=jnp.array(ts[order]),
            control=control,
            args=args,
            **tight_tolerances(1e-12),
        )
        states = jax.tree.map(lambda x: x[np.argsort(order)], (traj.states.q, traj.states.v))
        energy = jax.vmap(
            lambda q, v: svkc.kinetic_energy(chain, svkc.State(q, v, state.structure))
        )(*states)
        return jnp.tile(weight, 40) @ energy[:320] / 8, states[0][320:]

    (value, path), slope = jax.jit(jax.value_and_grad(functional, has_aux=True))(args)
    for column, name in enumerate(("q", "x", "p")):
        np.testing.assert_allclose(path[:, column], reference[name], atol=1e-10)
    assert float(value) == pytest.approx(expected["value"], rel=1e-11)
    np.testing.assert_allclose(slope, [expected["dG_dk"], expected["dG_dc"]], rtol=REFERENCE)


@pytest.mark.slow
def test_two_rods_latched():
    """Velocities, momenta and kinetic energy after a hinge and after a weld have closed forms."""
    case = load_reference("events")["latch_two_rods"]
    rod = (
        '<body name="{0}" pos="{1} 0 0"><joint name="{0}.x" type="slide" axis="1 0 0"/><joint'
        ' name="{0}.y" type="slide" axis="0 1 0"/>'
    )
    rod += (
        '<joint name="{0}.turn" axis="0 0 1"/><inertial pos="0 0 0" mass="{2}" diaginertia="{3} {3}'
        ' {3}"/></body>'
    )
    text = rod.format("one", 0, 1, 1 / 12) + rod.format("two", 1, 2, 2 / 12)
    links = [
        svkc.VirtualLink(kind, "one", "two", kind, pos=(0.5, 0, 0), real_pos=(-0.5, 0, 0))
        for kind in ("hinge", "weld")
    ]
    chain = svkc.load(
        f'<mujoco><option gravity="0 0 0"/><worldbody>{text}</worldbody></mujoco>',
        virtual_links=links,
    )
    before = chain.state(v=jnp.array(case["v_before"]), connected=())
    for kind, key, energy in (("hinge", "v_after_revolute", 1), ("weld", "v_after_weld", 2)):
        after = svkc.connect(chain, before, kind)
        np.testing.assert_allclose(after.v[:6], case[key], atol=1e-14)
        assert float(svkc.kinetic_energy(chain, after)) == pytest.approx(
            case["kinetic"][energy], rel=1e-14
        )
        linear, angular = svkc.momentum(chain, after)
        np.testing.assert_allclose([*linear[:2], angular[2]], case["momenta_before"], atol=1e-14)


@pytest.mark.slow
def test_pendulum_released():
    """A rod cut off its pin at an angle: time and rate of the event, and the flight."""
    case = load_reference("events")["pendulum_release"]
    rod = '<body name="rod"><joint name="pin" axis="0 0 1"/><inertial pos="0 -0.5 0" mass="1" '
    rod += f'diaginertia="{1 / 12!r} 0.01 {1 / 12!r}"/></body>'
    chain = svkc.load(
        f'<mujoco><option gravity="0 -9.81 0"/><worldbody>{rod}</worldbody></mujoco>',
        cuttable="pin",
    )
    # The z entry of the quaternion is sin(angle / 2): the event is at the angle -0.5.
    event = svkc.when(
        lambda t, s, args: svkc.poses(chain, s)[1][1, 3] + jnp.sin(0.25), cut="pin", direction=False
    )
    traj = svkc.simulate(
        chain,
        chain.state({"pin": np.pi / 2}),
        2.0,
        ts=jnp.array(case["t"]),
        events=[event],
        **tight_tolerances(1e-13),
    )
    assert float(traj.events.time[0]) == pytest.approx(case["t_event"], abs=ROUND_OFF)
    place, quat = (
        np.asarray(x)[:, 1] for x in jax.vmap(lambda s: svkc.poses(chain, s))(traj.states)
    )
    expected = np.array(case["theta_comx_comy"])
    com = place[:, :2] + 0.5 * np.stack([np.sin(expected[:, 0]), -np.cos(expected[:, 0])], 1)
    np.testing.assert_allclose(com, expected[:, 1:], atol=1e-11)
    half = np.stack([np.cos(expected[:, 0] / 2), np.sin(expected[:, 0] / 2)], 1)
    np.testing.assert_allclose(*align_quaternion_signs(quat[:, [0, 3]], half), atol=1e-11)


@pytest.mark.slow
def test_simple_pendulum_for_a_long_time():
    """IFToMM A01: a point mass on a massless rod over more than 42 periods."""
    case = load_reference("events")["a01_simple_pendulum"]
    rod = (
        '<body name="rod"><joint name="pin" axis="0 0 1"/><inertial pos="1 0 0" mass="1"'
        ' diaginertia="1e-15 1e-15 1e-15"/></body>'
    )
    chain = svkc.load(
        '<mujoco><compiler balanceinertia="false"/><option gravity="0 -9.81'
        f' 0"/><worldbody>{rod}</worldbody></mujoco>'
    )
    ts = [t for t in case["t"] if t <= 100]
    traj = svkc.simulate(chain, chain.state(), 100.0, ts=jnp.array(ts), **tight_tolerances(1e-13))
    positions = np.stack([np.cos(traj.states.q[:, 0]), np.sin(traj.states.q[:, 0])], 1)
    np.testing.assert_allclose(positions, case["xy"][: len(ts)], atol=REFERENCE)


@pytest.mark.slow
def test_locking_an_elbow():
    """Rate, angular momentum and kinetic energy after an elbow is locked have closed forms."""
    case = load_reference("events")["joint_lock"]
    rod = (
        '<body name="{0}" pos="{1}"><joint name="{0}" axis="0 0 1"/><inertial pos="0 -0.5 0"'
        ' mass="1" diaginertia="{2} 0.01 {2}"/>{3}</body>'
    )
    text = rod.format(
        "shoulder", "0 0 0", repr(1 / 12), rod.format("elbow", "0 -1 0", repr(1 / 12), "")
    )
    chain = svkc.load(
        f'<mujoco><option gravity="0 -9.81 0"/><worldbody>{text}</worldbody></mujoco>'
    )
    before = chain.state({"elbow": 0.8}, {"shoulder": 2.0, "elbow": -5.0})
    after = svkc.lock(chain, before, "elbow")
    np.testing.assert_allclose(after.v, [case["rate_after"], 0], atol=1e-14)
    for state, energy in zip((before, after), case["kinetic"], strict=True):
        assert float(svkc.kinetic_energy(chain, state)) == pytest.approx(energy, rel=1e-14)
        # The angular momentum about the shoulder, which the pin on the ground cannot change.
        assert float((svkc.mass_matrix(chain, state) @ state.v)[0]) == pytest.approx(
            case["angular_momentum"], rel=1e-14
        )


@pytest.mark.slow
def test_a_bouncing_ball_with_restitution():
    """25 bounces with restitution, towards the accumulation point of their times.

    Impacts of svkc are plastic: each bounce is a run that ends at the ground, a reversed velocity,
    and the next run.
    """
    case = load_reference("events")["bouncing_ball_zeno"]
    ball = (
        '<body name="ball"><joint name="z" type="slide" axis="0 0 1"/><inertial pos="0 0 0"'
        ' mass="1" diaginertia="1 1 1"/></body>'
    )
    chain = svkc.load(
        f'<mujoco><option gravity="0 0 -9.81"/><worldbody>{ball}</worldbody></mujoco>'
    )
    # In micrometres: a guard within 1.8e-12 of zero counts as zero, and the last flights are lower
    # than 1.8e-12 m.
    ground = svkc.when(lambda t, s, args: 1e6 * s.q[0], stop=True, direction=False)

    @jax.jit
    def simulate_flight(state):
        # Steps are shorter than a flight: a longer one has the ball below the ground at both ends.
        max_step = jnp.maximum(jnp.abs(state.v[0]) / 9.81, jnp.where(state.q[0] > 0.5, 0.1, 0))
        controller = diffrax.PIDController(rtol=1e-12, atol=1e-15, dtmax=max_step)
        return svkc.simulate(chain, state, 2.0, events=[ground], stepsize_controller=controller)

    state, time = chain.state({"z": 1.0}), 0.0
    for impact in case["impacts"]:
        end = simulate_flight(state)
        time = time + float(end.events.time[0])
        assert time == pytest.approx(impact, abs=ROUND_OFF)
        state = svkc.State(end.final.q, -0.5 * end.final.v, end.final.structure)
    assert float(end.final.v[0]) == pytest.approx(-np.sqrt(2 * 9.81) * 0.5**24, rel=1e-6)
