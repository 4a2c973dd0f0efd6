"""What `print` and notebooks show of chains, runs and results; lanes of a batch."""

import pathlib
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest

import svkc

SAVED = pathlib.Path(__file__).parent / "saved"


@pytest.fixture(scope="module")
def run():
    """Return a falling rod that a hook catches and releases, and its run.

    Numbers of the run that are round-off are replaced.
    """
    links = [svkc.VirtualLink("hook", "world", "rod", "weld", pos=(0, 0, 0.5))]
    rod = models.MJCF.format(models.bar("rod", models.Y, "0 0 -1"))
    chain, ts = svkc.load(rod, virtual_links=links), jnp.linspace(0, 0.3, 4)
    events = [svkc.at(0.1, connect="hook", here=True), svkc.at(0.2, cut="hook")]
    traj = svkc.simulate(chain, chain.state({"rod": 1.2}), 0.3, ts=ts, dt=0.01, events=events)
    p, full = traj.phases, lambda x, value: jnp.full_like(x, value)
    energy = jnp.array([[1.0, 1.5]] * 3)
    return chain, eqx.tree_at(
        lambda t: (t.phases.energy, t.phases.work, t.phases.error, t.phases.gap, t.gaps),
        traj,
        (energy, full(p.work, 0.499), full(p.error, 1e-9), full(p.gap, 0), full(traj.gaps, 0)),
    )


@pytest.fixture(scope="module")
def batch(run):
    """Return 512 lanes, two of which failed; one lost other energy."""
    one = jax.tree.map(np.asarray, run[1])
    traj = jax.tree.map(lambda x: np.stack([x] * 512), one)
    traj.result._value[[17, 40]] = svkc.RESULTS.max_steps._value
    traj.events.energy_lost[3, 0] = 100
    return jax.tree.map(jnp.asarray, traj)


@pytest.fixture(scope="module")
def results(run):
    """Return the mobility of the chain and torques for an acceleration of it."""
    chain, traj = run
    return svkc.mobility(chain, traj.final), svkc.actuation(chain, traj.final, jnp.ones(1))


def stack(thing, *lanes):
    """Return a batch of equal objects."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (*lanes, *x.shape)), thing)


CHAIN = """\
Chain: 1 body, 1 joint, 1 virtual link, 0 actuators, 1 joint freedom in the tree, \
1 with every virtual link
body  parent  joint  kind   freedoms  mass (kg)
rod   world   rod    hinge         1      2.941

virtual link  joint  freedoms  parent  real  connected  distance on real to
                                                             its origin (m)
hook          weld          0  world   rod   no                         0.5
hook: real_pos was not given. It was computed from the load pose, where the point of the joint on \
world is 0.5 m from the origin of rod"""

RUN = """\
Trajectory: t = 0 to 0.3 s, 4 save times, 3 phases, 2 events
    from        to  held by     joint  rank  mobility  steps  energy drift
       s         s           freedoms                                    J
0.000000  0.100000  nothing         1     0         1     11      1.00e-03
0.100000  0.200000  hook            1     1         0     11      1.00e-03
0.200000  0.300000  nothing         1     0         1     10      1.00e-03

    time  event  connected  cut   energy lost
       s  index                             J
0.100000      0  hook       -          0.9087
0.200000      1  -          hook            0

joint  unit  at the first  at the last    min  max  largest speed
                save time                                  unit/s
rod    rad            1.2        1.066  1.066  1.2          1.347
no fault found: energy drift is 3.3e-03 of the kinetic energy"""

BATCH = """\
Trajectories of 512 lanes: t = 0 to 0.3 s, 4 save times, 3 phases, 2 events
event  connected  cut   lanes     first    median      last
index                                 s         s         s
    0  hook       -       512  0.100000  0.100000  0.100000
    1  -          hook    512  0.200000  0.200000  0.200000

                                   min  median    max  lane of max
end (s)                            0.3     0.3    0.3            0
steps                               32      32     32            0
rejected steps                       0       0      0            0
energy drift, without sign (J)   0.003   0.003  0.003            0
energy lost in impacts (J)      0.9087  0.9087    100            3
largest loop gap (m)                 0       0      0            0
largest loop gap (rad)               0       0      0            0
errors of steps, summed          3e-09   3e-09  3e-09            0
rank margin                          1       1      1            0

ended        successful: 510, max_steps: 2 (first lane 17)
derivatives  successful: 512
verdict      worst of 512 lanes, lane 17: the run did not reach its end: More steps than \
max_steps in one phase. Raise max_steps, or loosen rtol and atol."""


def test_a_chain_names_links_whose_place_is_that_of_the_load_pose(run):
    chain = run[0]
    assert str(chain) == CHAIN
    assert repr(chain) == f"<{CHAIN.splitlines()[0]}>"
    masses = jnp.outer(jnp.array([1.0, 2.0]), chain.mass)
    assert "  2.941 to 5.881\n" in str(eqx.tree_at(lambda c: c.mass, stack(chain, 2), masses))


def test_a_run(run):
    traj = run[1]
    assert str(traj) == RUN
    assert repr(traj) == f"<{RUN.splitlines()[0]}: successful>"
    assert str(traj.result) == str(traj.derivative) == "successful"
    assert repr(traj.result) == "RESULTS<successful>"


@pytest.mark.slow
def test_a_virtual_link_with_the_name_of_a_joint():
    """The table of joints has the joint, not the link."""
    link = svkc.VirtualLink("arm", "world", "arm", "ball", real_pos=(0, 0, -1))
    chain = svkc.load(models.ARM, virtual_links=[link])
    traj = svkc.simulate(chain, chain.state({"arm": 0.7}, connected=()), 0.1, dt=0.05)
    rows = [line for line in str(traj).splitlines() if line.startswith("arm ")]
    assert len(rows) == 1
    assert rows[0].split()[:3] == ["arm", "rad", "0.7"]


def test_a_batch(batch):
    assert str(batch) == BATCH
    assert str(batch.report()) == "\n".join(BATCH.splitlines()[6:])
    assert str(batch.result) == "successful: 510, max_steps: 2 (first lane 17)"
    two_axes = jax.tree.map(lambda x: np.asarray(x).reshape(2, 256, *x.shape[1:]), batch)
    assert str(two_axes).startswith("Trajectories of 2x256 lanes: t = 0 to 0.3 s")
    assert str(two_axes[:, 200:].result) == "successful: 112"
    assert str(two_axes.result).endswith("max_steps: 2 (first lane 0, 17)")


def test_many_events_are_counted(batch):
    """The text of 512 lanes stays below 25 lines."""
    rows = 12
    several = jnp.broadcast_to(jnp.arange(rows, dtype=jnp.int32), (512, rows))
    times = jnp.broadcast_to(jnp.linspace(0.1, 0.2, rows), several.shape)
    busy = eqx.tree_at(lambda t: (t.events.which, t.events.time), batch, (several, times))
    lines = str(busy).splitlines()
    assert len(lines) < 25
    assert f"... {rows - 4} more rows" in lines


def test_mobility_and_actuation(results):
    mobility, actuation = results
    assert str(mobility).splitlines()[2:] == [
        "mobility (N_F = N_J - m)  1", "independent coordinates: rod", "  hook:  not connected",
    ]  # fmt: skip
    first, titles, row, last = str(actuation).splitlines()
    assert first == (
        "Actuation: rank of S 1, redundant actuators 0, freedoms that no actuator drives 0"
    )
    assert titles == "joint  unit  torque or force  residual"
    assert row.split() == ["rod", "N", "m", f"{float(actuation.tau[0]):.4g}", "0"]
    assert last == "no torque on 0 other joint coordinates"
    assert "Mobility of 512 lanes" in str(stack(mobility, 512))
    assert "\nhook          0" in re.sub(" +", "          ", str(stack(mobility, 512)))
    assert "rod (N m)" in str(stack(actuation, 2, 3))


def test_html_has_the_cells_of_the_text(run, batch, results):
    for thing in (*run, batch, batch.report(), run[1].report(), *results):
        page = re.sub(r"<br>|<[^>]*>", " ", thing._repr_html_()).split()
        page = " ".join(page).replace("&lt;", "<").replace("&gt;", ">")
        for cell in re.split(r"\s{2,}|\n", str(thing)):
            assert all(word in page for word in cell.split()), (cell, page)


def test_objects_without_values_are_shown_by_their_structure(run, results):
    """Traced, abstract, and with a field that was filtered out."""
    things = (*run, run[1].report(), run[1].result, *results)
    texts = []

    def show(things):
        texts.extend(f(x) for x in things for f in (str, repr))
        texts.extend(x._repr_html_() for x in things if hasattr(x, "_repr_html_"))
        return things

    shapes = jax.eval_shape(show, things)
    show(shapes)
    show(jax.tree.map(lambda x: None, things))
    assert all(texts)
    assert "ts=f64[4]" in texts[2]


@pytest.mark.parametrize("arrays", ["numpy", pytest.param("jax", marks=pytest.mark.slow)])
def test_lanes(batch, arrays):
    """`traj[i]` is `tree_map` over one axis of lanes or two."""
    if arrays == "numpy":
        batch = jax.tree.map(np.asarray, batch)
    assert bool(eqx.tree_equal(batch[3], jax.tree.map(lambda x: x[3], batch)))
    assert float(batch[-509].events.energy_lost[0]) == 100
    failed = np.asarray(batch.result == svkc.RESULTS.max_steps)
    for some in (batch[failed], batch[[17, 40]], batch[17:41:23]):
        assert str(some.result) == "max_steps: 2"
    two_axes = jax.tree.map(lambda x: x.reshape(2, 256, *x.shape[1:]), batch)
    assert bool(eqx.tree_equal(two_axes[1, 5], batch[261]))
    assert two_axes[1].ts.shape == (256, 4)
    assert len(list(batch[:5])) == 5
    traced = jax.jit(lambda traj, i: traj[i].events.energy_lost[0])(batch, 3)
    assert float(traced) == 100
    for index in (512, (0, 0), (slice(None), 1)):
        with pytest.raises(IndexError, match=r"traj\[.*no such lane of \(512,\)"):
            batch[index]
    with pytest.raises(ValueError, match="this is a single run"):
        batch[0][0]


def test_names_stay_through_transformations(run, batch):
    traj = run[1]
    assert batch.names is batch.report().names is traj.names
    assert jax.jit(jax.vmap(lambda t: t))(batch[:2]).names is traj.names
    assert jax.grad(lambda t: jnp.sum(t.final.q), allow_int=True)(traj).names is traj.names


@pytest.mark.parametrize("schema", [4, 5])
def test_files_without_names(schema):
    text = str(svkc.load_trajectory(SAVED / f"schema_{schema}.npz"))
    assert "0.200000  0.300000  link 0 " in text
