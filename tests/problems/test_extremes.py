"""Extremes of size, mass, speed, stiffness and count, in float64 and float32, each with its bound.

The last section holds the limits of float32.
"""

import types

import diffrax
import jax
import jax.numpy as jnp
import maximal
import models
import numpy as np
import pytest
from reference_problems import n_four_bar
from tolerances import REFERENCE, ROUND_OFF

import svkc

pytestmark = pytest.mark.slow

SPACE = (
    '<mujoco><compiler balanceinertia="false" boundmass="0" boundinertia="0"/><option gravity="0 0'
    ' -9.81"/><worldbody>{}</worldbody></mujoco>'
)
FINE = {"rtol": 1e-9, "atol": 1e-11}


# Bounds of each precision. A drift of energy is relative to the kinetic energy.
BOUNDS = {
    "double": types.SimpleNamespace(
        # tolerances of the runs
        fine=FINE,
        # a four-bar of a kilometre on a bar of a millimetre: energy drift, loop gap (m)
        large=(1e-8, np.inf),
        # 1e6 m from the origin: coordinates, velocities
        far=(3e-7, 3e-6),
        # 1e3 rad/s for 160 turns: energy drift, relative drift of the angular momentum
        spin=(1e-7, 1e-7),
        spin_by={"rtol": 1e-10, "atol": 1e-12, "solver": diffrax.Dopri8()},
        # two hundred links: energy drift
        links=1e-6,
        links_by={},
        # twenty loops: energy drift of each run, loop gap
        loops=(1e-5, 1e-12),
        drift_of_runs=np.max,
        # 1e9 N/m: angle of a pendulum (rad), the most steps of an implicit solver
        springs=1e-6,
        springs_steps=200,
    ),
    # float32 resolves positions of 1e6 m to 6 cm. Accelerations of two hundred links have errors of
    # 1e-2, which no tolerance can go below: these runs use fixed steps.
    "single": types.SimpleNamespace(
        fine={},
        large=(3e-4, 1e-3),
        far=(5e-3, 0.1),
        spin=(1e-2, 1e-3),
        spin_by={},
        links=5e-2,
        links_by={"dt": 1e-3},
        loops=(5e-4, 1e-5),
        drift_of_runs=np.median,
        springs=1e-5,
        springs_steps=100,
    ),
}


@pytest.fixture(params=BOUNDS)
def bounds(request):
    """Return the bounds of one precision, which is set during the test."""
    with jax.enable_x64(request.param == "double"):
        yield BOUNDS[request.param]


@pytest.fixture
def single():
    """Set float32 during the test."""
    with jax.enable_x64(False):
        yield


def rods(masses, lengths):
    """Return a hanging chain of slender rods on hinges about y."""
    out = ""
    for i, (m, l) in reversed(list(enumerate(zip(masses, lengths, strict=True)))):
        inertia, above = m * l * l / 12, 0.0 if i == 0 else -lengths[i - 1]
        joint = f'<joint name="j{i}" axis="0 1 0"/>'
        inertial = (
            f'<inertial pos="0 0 {-l / 2!r}" mass="{m!r}" diaginertia="{inertia!r} {inertia!r}'
            f' {inertia!r}"/>'
        )
        out = f'<body name="b{i}" pos="0 0 {above!r}">{joint}{inertial}{out}</body>'
    return svkc.load(SPACE.format(out))


def zigzag(chain, angle=0.3):
    """Return the state with angles of alternating sign."""
    return chain.state({name: angle * (-1) ** i for i, name in enumerate(chain.joint_names)})


def relative_energy_drift(chain, traj):
    """Return the largest change of the energy relative to the largest kinetic energy."""
    energy = jax.vmap(lambda s: svkc.energy(chain, s))(traj.states)
    kinetic_energy = jax.vmap(lambda s: svkc.kinetic_energy(chain, s))(traj.states)
    return float(np.max(np.abs(energy - energy[0])) / np.max(kinetic_energy))


# A numpy array is converted to the precision of the run.
TIMES = np.linspace(0, 1, 11)


@pytest.mark.parametrize(
    "masses",
    [10.0 ** (6 - 2.0 * np.arange(7)), np.tile([1e6, 1e-6], 4)[:7], np.tile([1e-6, 1e6], 4)[:7]],
    ids=["falling", "heavy", "light"],
)
def test_masses_from_a_milligram_to_a_thousand_tons(masses):
    """Chains of seven rods of unlike masses conserve energy."""
    chain = rods([float(m) for m in masses], [1.0] * 7)
    traj = svkc.simulate(chain, zigzag(chain), 1.0, ts=TIMES, **FINE)
    assert relative_energy_drift(chain, traj) < REFERENCE


def test_masses_in_a_loop():
    """A four-bar with bars of a milligram, a kilogram and a thousand tons, in every order."""
    chain = models.four_bar()
    run = jax.jit(
        lambda chain: svkc.simulate(chain, chain.state(v={"crank": 4.0}), 1.0, ts=TIMES, **FINE)
    )
    for order in ((1e-6, 1.0, 1e6), (1e6, 1e-6, 1.0), (1.0, 1e6, 1e-6)):
        ratio = chain.mass[1:4] / np.array(order)
        varied = jax.tree.map(lambda x: x, chain)
        mass = chain.mass.at[1:4].divide(ratio)
        inertia = chain.inertia.at[1:4].divide(ratio[:, None, None])
        varied = chain.__class__(**{**vars(varied), "mass": mass, "inertia": inertia})
        traj = run(varied)
        assert relative_energy_drift(varied, traj) < 1e-8
        assert float(traj.gaps.max()) < 1e-13


def four_bar_on_a_bar(small):
    """Return a four-bar with links of about `small` metres at the end of a bar of 1 / small."""
    bar = lambda *p: (
        f'<geom type="capsule" fromto="0 0 0 {" ".join(repr(x * small) for x in p)}"'
        f' size="{0.03 * small}" mass="1" contype="0"/>'
    )
    vector = lambda *p: " ".join(repr(x * small) for x in p)
    rocker = (
        f'<body name="rocker" pos="{vector(1, 0, 0.2)}"><joint name="rocker" axis="0 1'
        f' 0"/>{bar(0.2, 0, -0.6)}</body>'
    )
    coupler = (
        f'<body name="coupler" pos="{vector(0, 0, 0.4)}"><joint name="coupler" axis="0 1'
        f' 0"/>{bar(1, 0, 0.2)}{rocker}</body>'
    )
    crank = (
        f'<body name="crank" pos="0 0 {-1 / small}"><joint name="crank" axis="0 1'
        f' 0"/>{bar(0, 0, 0.4)}{coupler}</body>'
    )
    long = (
        f'<geom type="capsule" fromto="0 0 0 0 0 {-1 / small}" size="{0.01 / small}" mass="1"'
        ' contype="0"/>'
    )
    pin = svkc.VirtualLink(
        "pin",
        "big",
        "rocker",
        "hinge",
        axis=(0, 1, 0),
        pos=(1.2 * small, 0, -1 / small),
        real_pos=(0.2 * small, 0, -0.6 * small),
        connected=True,
    )
    return svkc.load(
        SPACE.format(f'<body name="big"><joint name="big" axis="0 1 0"/>{long}{crank}</body>'),
        virtual_links=[pin],
    )


def test_a_kilometre_at_the_end_of_a_millimetre(bounds):
    """A large four-bar on a short bar conserves energy and stays closed."""
    chain = four_bar_on_a_bar(1e3)
    traj = svkc.simulate(chain, chain.state(v={"crank": 4.0}), 1.0, ts=TIMES, **bounds.fine)
    assert relative_energy_drift(chain, traj) < bounds.large[0]
    assert float(traj.gaps[:, 1].max()) < bounds.large[1]


def test_a_millimetre_at_the_end_of_a_kilometre():
    """A small four-bar on a long bar: round-off of the inertia about the distant root shows.

    That inertia is 1e12 times the one of the four-bar. Energy drifts by 9e-3 of the kinetic energy.
    float32 cannot resolve the four-bar; a result code reports that.
    """
    chain = four_bar_on_a_bar(1e-3)
    state = chain.state(v={"crank": 4.0})
    assert svkc.mobility(chain, state).freedoms == 2
    traj = svkc.simulate(chain, state, 0.05, ts=0.05 * TIMES, dt=1e-4)
    assert float(traj.gaps[:, 1].max()) < ROUND_OFF
    assert relative_energy_drift(chain, traj) < 2e-2
    with jax.enable_x64(False):
        chain = four_bar_on_a_bar(1e-3)
        state = chain.state(v={"crank": 4.0})
        traj = svkc.simulate(chain, state, 0.05, ts=0.05 * TIMES, dt=1e-4, throw=False)
        assert traj.result == svkc.RESULTS.non_finite
        assert np.isfinite(traj.states.q).all()
        assert np.isfinite(traj.states.q).all()


def two_bars():
    """Return two bars joined by a hinge, floating."""
    return svkc.load(
        models.MJCF.format(
            models.bar(
                "a",
                'type="free"',
                "0 0 -0.5",
                inside=models.bar("b", models.Y, "0.3 0 -0.3", "0 0 -.5"),
            )
        )
    )


THROWN = [0.5, 0.1, 0.2, 1, 2, 3, 1.5]


def test_far_away_and_fast(bounds):
    """1e6 m from the origin at 1e3 m/s the relative motion is that at the origin.

    The bound is the resolution of positions of 1e6 m.
    """
    chain = two_bars()
    run = jax.jit(lambda state: svkc.simulate(chain, state, 1.0, throw=False, **bounds.fine))
    q, v = np.array(chain.q_load), np.array(THROWN, chain.q_load.dtype)
    near = run(chain.state(q, v))
    there, speed = np.array([1e6, -1e6, 1e6]), np.array([1e3, -1e3, 1e3])
    q[:3] += there
    v[:3] += speed
    far = run(chain.state(q, v))
    np.testing.assert_allclose(far.final.q[3:], near.final.q[3:], atol=bounds.far[0])
    np.testing.assert_allclose(far.final.v[3:], near.final.v[3:], atol=bounds.far[1])
    if q.dtype == np.float64:
        np.testing.assert_allclose(far.final.q[:3] - there - speed, near.final.q[:3], atol=1e-6)


WEIGHTLESS = SPACE.replace("0 0 -9.81", "0 0 0").format(
    models.bar("a", 'type="free"', "0.2 0.3 -0.5")
)
SPIN = [0, 0, 0, 1e3, 20, -30.0]


def test_fast_spin(bounds):
    """1e3 rad/s for 160 turns conserve energy and angular momentum."""
    chain = svkc.load(WEIGHTLESS)
    state = chain.state(v=np.array(SPIN, chain.q_load.dtype))
    traj = svkc.simulate(chain, state, 1.0, ts=TIMES, **bounds.spin_by)
    assert relative_energy_drift(chain, traj) < bounds.spin[0]
    magnitude = float(jnp.linalg.norm(svkc.momentum(chain, state)[1]))
    assert float(traj.report().angular_momentum_drift) < bounds.spin[1] * magnitude


def test_two_hundred_links(bounds):
    """A chain of twenty metres of links of ten centimetres conserves energy."""
    chain = rods([0.1] * 200, [0.1] * 200)
    traj = svkc.simulate(chain, zigzag(chain, 0.05), 0.1, ts=0.1 * TIMES, **bounds.links_by)
    assert relative_energy_drift(chain, traj) < bounds.links


def parallel_legs(count):
    """Return a plate on parallel legs, one leg more than `count` pins."""
    bodies = ""
    for i in range(count + 1):
        plate = models.bar("plate", models.Y, "20 0 0", "0 0 1") if i == 0 else ""
        bodies += models.bar(
            f"leg{i}", models.Y, "0 0 1", f"{i if count > 1 else 20 * i} 0 0", plate
        )
    links = [
        svkc.VirtualLink(
            f"pin{i}",
            "plate",
            f"leg{i}",
            "hinge",
            pos=(i if count > 1 else 20.0, 0, 0),
            real_pos=(0, 0, 1),
            axis=(0, 1, 0),
            connected=True,
        )
        for i in range(1, count + 1)
    ]
    return svkc.load(SPACE.format(bodies), virtual_links=links)


def test_twenty_loops(bounds):
    """Twenty-one parallel legs under one plate have one freedom: most loops are redundant.

    In float32 the energy drift of one run depends on round-off: 2e-5 to 6e-4 from angles that
    differ by 1e-6. Its bound is that of the median of five runs, in float64 that of each run.
    """
    chain = parallel_legs(20)
    run = jax.jit(lambda state: svkc.simulate(chain, state, 1.0, ts=TIMES))
    trajectories = [run(chain.state({"leg0": 0.3 + 1e-6 * i})) for i in range(5)]
    assert svkc.mobility(chain, chain.state({"leg0": 0.3})).freedoms == 1
    drifts = [relative_energy_drift(chain, traj) for traj in trajectories]
    assert bounds.drift_of_runs(drifts) < bounds.loops[0]
    assert max(float(traj.gaps.max()) for traj in trajectories) < bounds.loops[1]
    for traj in trajectories:
        angles = np.asarray(traj.final.q)[[chain.dof_names.index(f"leg{i}") for i in range(21)]]
        np.testing.assert_allclose(angles, angles[0], atol=bounds.loops[1])


def sprung_and_rigid():
    """Return a pendulum on a spring of 1e9 N/m, and one on a rigid pivot."""
    slide = '<joint name="a" type="slide" axis="0 0 1" stiffness="1e9" damping="1e4"/>'
    ball = '<geom size=".1" mass="1" contype="0"/>'
    pendulum = (
        '<body name="b" pos="0 0 -1"><joint name="b" axis="0 1 0"/><geom size=".1" mass="1" pos="0'
        ' 0 -.5" contype="0"/></body>'
    )
    sprung = svkc.load(SPACE.format(f'<body name="a">{slide}{ball}{pendulum}</body>'))
    return sprung, svkc.load(SPACE.format(pendulum))


@pytest.mark.parametrize(
    "solver", [diffrax.Tsit5(), diffrax.Kvaerno5()], ids=["explicit", "implicit"]
)
def test_stiff_springs(bounds, solver):
    """A pendulum on a spring of 1e9 N/m moves as on a rigid pivot, up to the stretch of the spring.

    The implicit solver takes fewer steps.
    """
    chain, rigid = sprung_and_rigid()
    traj = svkc.simulate(chain, chain.state({"b": 0.5}), 0.1, solver=solver)
    expected = svkc.simulate(rigid, rigid.state({"b": 0.5}), 0.1, **bounds.fine)
    assert float(traj.final.q[1]) == pytest.approx(float(expected.final.q[0]), abs=bounds.springs)
    implicit = isinstance(solver, diffrax.Kvaerno5)
    assert int(traj.report().accepted) < (bounds.springs_steps if implicit else 3000)


def test_no_inertia_at_the_end_of_a_ball():
    """A body without inertia at a ball joint is refused by name; one of tiny inertia is simulated.

    The inertia about its axis is 4e-12 of the other two, so its acceleration has a round-off of
    5e-5. Solvers with tolerances below that take ever more steps.
    """
    point = (
        '<body name="tip"><joint name="tip" type="ball"/><inertial pos="0 0 -{}" mass="{}"'
        ' diaginertia="{} {} {}"/></body>'
    )
    with pytest.raises(ValueError, match="tip"):
        svkc.load(SPACE.format(point.format(0.5, 1, 0, 0, 0)))
    chain = svkc.load(SPACE.format(point.format(0.5, 1, 1e-12, 1e-12, 1e-12)))
    state = chain.state(v={"tip": [1.0, 0.5, 0.1]})
    for tolerances in ({}, {"rtol": 1e-8, "atol": 1e-10}):
        traj = svkc.simulate(chain, state, 1.0, ts=TIMES, **tolerances)
        assert relative_energy_drift(chain, traj) < ROUND_OFF
        # No torque acts about the axis of symmetry.
        np.testing.assert_allclose(traj.states.v[:, 2], 0.1, atol=1e-6)
    # A smaller tolerance takes 23 thousand steps.
    traj = svkc.simulate(chain, state, 1.0, ts=TIMES, solver=diffrax.Tsit5(), **FINE)
    assert relative_energy_drift(chain, traj) < 1e-7
    assert (
        svkc.simulate(chain, state, 1.0, rtol=1e-11, atol=1e-13, throw=False).result
        == svkc.RESULTS.max_steps
    )


def test_chattering_ends_with_a_code():
    """A joint that is locked and unlocked infinitely often ends the run with `max_events`.

    The state of the last event is kept.
    """
    body = (
        '<body name="ball"><joint name="z" type="slide" axis="0 0 1"/><geom size="0.1" mass="1"'
        ' contype="0"/></body>'
    )
    chain = svkc.load(SPACE.format(body))
    wave = lambda t, s, args: jnp.sin(1.0 / (0.1001 - t))
    events = [
        svkc.when(wave, lock="z", direction=True),
        svkc.when(wave, unlock="z", direction=False),
    ]
    traj = svkc.simulate(
        chain, chain.state(), 0.2, events=events, max_events=12, dt=1e-4, throw=False
    )
    assert traj.result == svkc.RESULTS.max_events
    assert int(traj.events.count) == 12
    assert np.isfinite(traj.final.q).all()
    assert 0 < float(traj.t_final) < 0.1001
    with pytest.raises(RuntimeError, match="max_events"):
        svkc.simulate(chain, chain.state(), 0.2, events=events, max_events=12, dt=1e-4)


def test_velocities_inconsistent_with_the_loops_are_projected():
    """An inconsistent velocity is projected by the least change; gap_rates reports it."""
    chain = models.four_bar()
    state = chain.state(v=np.array([1.0, -3.0, 2.0]))
    assert float(jnp.max(jnp.abs(svkc.loop_gap_rates(chain, state)))) < 1e-13
    raw = svkc.State(state.q, state.v.at[0].add(5.0), state.structure)
    traj = svkc.simulate(chain, raw, 0.1, **FINE)
    assert float(traj.gap_rates[-1].max()) < ROUND_OFF


# Limits of float32.


def test_single_precision():
    """float32 has bounds of its own; float64 input where x64 is off warns once.

    The scenes are the N four-bar and a chain of unlike masses.
    """
    with jax.enable_x64(False):
        chain, state = maximal.load(n_four_bar(2))
        assert state.q.dtype == jnp.float32
        traj = svkc.simulate(chain, state, 2.0, ts=2 * TIMES, rtol=1e-5, atol=1e-6)
        assert float(traj.gaps.max()) < 1e-5
        assert abs(float(traj.report().energy_drift)) < 1e-2 * 35.8
        chain = rods([1e3, 1.0, 1e-3], [1.0] * 3)
        traj = svkc.simulate(chain, zigzag(chain), 1.0, ts=TIMES)
        assert relative_energy_drift(chain, traj) < 1e-3
        chain = models.four_bar()
        with pytest.warns(UserWarning, match="v in float64, kept in float32") as warnings:
            state = chain.state(v=np.array([1.0, 0.0, 0.0]))
        assert len(warnings) == 1
        svkc.simulate(chain, state, np.float64(0.1), ts=np.linspace(0, 0.1, 3))
    wide = models.four_bar()
    state = wide.state()
    with (
        jax.enable_x64(False),
        pytest.raises(ValueError, match="float64, but jax_enable_x64 is off"),
    ):
        svkc.simulate(wide, state, 0.1)


def test_the_high_bar_in_single_precision():
    """Ten seconds on the bar by both hands: projection keeps the loops closed."""
    with jax.enable_x64(False):
        chain, state = svkc.scenes.high_bar(ignore=("limit",))
        traj = svkc.simulate(chain, state, 10.0, ts=jnp.linspace(0, 10, 101))
        assert traj.final.structure.connected.all()
        assert traj.states.q.dtype == jnp.float32
        assert float(traj.gaps[:, 1].max()) < 1e-5
        assert float(traj.gaps[:, 0].max()) < 1e-5


def test_a_hundred_thousand_steps(single):
    """The loop stays closed over 1e5 fixed steps in float32.

    Rounding of the time changes their number by a thousandth.
    """
    chain = models.four_bar()
    traj = svkc.simulate(
        chain,
        chain.state(v={"crank": 4.0}),
        10.0,
        ts=10 * TIMES,
        dt=1e-4,
        solver=svkc.integrators.SymplecticEuler(),
    )
    assert int(traj.report().accepted) == pytest.approx(100_000, rel=2e-3)
    assert float(traj.report().gap) < 2e-5
    assert relative_energy_drift(chain, traj) < 1e-2


@pytest.mark.parametrize("name", ["four_bar", "two_bars", "deep"])
def test_both_precisions_in_one_process(name):
    """One model in float64, then float32, then float64 again gives the results of separate
    processes."""
    make = {
        "four_bar": models.four_bar,
        "two_bars": two_bars,
        "deep": lambda: rods([0.1] * 40, [0.1] * 40),
    }[name]

    def results():
        chain = make()
        state = chain.state(v=np.linspace(-1, 1, chain.nv, dtype=chain.q_load.dtype))
        articulated = svkc.dynamics.ArticulatedBodies()
        stepped = svkc.step(chain, state, jnp.zeros(chain.nv), 1e-3)
        run = svkc.simulate(chain, state, 0.01, dt=2e-3, dynamics=articulated)
        return [
            np.asarray(x, float)
            for x in (
                svkc.forward_dynamics(chain, state, jnp.zeros(chain.nv)),
                stepped.v,
                run.final.q,
            )
        ]

    double = results()
    with jax.enable_x64(False):
        single = results()
    for a, b in zip(double, single, strict=True):
        np.testing.assert_allclose(b, a, atol=2e-3 * np.abs(a).max())
    for a, b in zip(double, results(), strict=True):
        np.testing.assert_array_equal(a, b)
