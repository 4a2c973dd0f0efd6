"""Complete runs of the high bar, with events and report: one of 10 s, and thousands in a batch.

`python benchmarks/runs.py [--lanes 4096]` prints and writes results/runs.csv.

One run: two hands until 8 s, one until 9 s, then flight. Batch: 1.8 s; the right hand releases at
0.3 to 0.9 s, the left one 0.2 s later. `unequal`: the lanes end at 0.1 to 1.8 s. Times are medians
of rounds in which all compared programs alternate, with the XLA option that speed.py sets. MuJoCo:
symplectic Euler steps of 5 ms of the same figure, with soft grips that are never released.

The error is the root mean square over the tree's coordinates at the end, against Dopri8 at rtol
1e-11; in a batch, the median over `REFERENCE_LANES` lanes. Ten seconds of undamped limbs are
chaotic, so that only the energy drift of that run is meaningful. Joint ranges are left out unless
the label names them. Without ranges limbs reach 100 rad/s, and with symplectic Euler of 5 ms one in
ten of 4096 lanes is not finite.
"""

import argparse
import csv

import speed  # first: sets XLA_FLAGS

# isort: split
import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import speed_cases

import svkc

ARTICULATED = {"dynamics": svkc.dynamics.ArticulatedBodies()}
EULER = {
    "solver": svkc.integrators.SymplecticEuler(),
    "stabilization": svkc.stabilization.Projection(iterations=1),
    **ARTICULATED,
}
TSIT5 = {"solver": diffrax.Tsit5(), "rtol": 1e-4, "atol": 1e-6, **ARTICULATED}
SINGLE_RUN_METHODS = {"default": {}, "articulated bodies": ARTICULATED}
BATCH_METHODS = {
    "symplectic Euler, 2.5 ms": {"dt": 2.5e-3, **EULER},
    "Tsit5, rtol 1e-4": TSIT5,
}
BATCH_METHODS_WITH_RANGES = {"with ranges: symplectic Euler, 5 ms": {"dt": 5e-3, **EULER}}
HEAD = [
    "runs",
    "by",
    "s",
    "least",
    "most",
    "simulated s per s",
    "error",
    "energy drift J",
    "steps",
    "rejected",
]
REFERENCE = {"rtol": 1e-11, "atol": 1e-13, "max_steps": 100000}
REFERENCE_LANES, ROUNDS, END = 8, 3, 1.8


def events(right, left):
    """Return the release of each hand, at the given times (s)."""
    return [svkc.at(right, cut="right_hand_grip"), svkc.at(left, cut="left_hand_grip")]


def final_error(chain, traj, reference) -> float:
    """Return the root mean square error at the end, over the tree's coordinates."""
    difference = svkc.difference(chain, reference.final.q, traj.final.q)[: chain.nv]
    return float(jnp.sqrt(jnp.mean(difference**2)))


def result_row(label, who, seconds, simulated, error, phases):
    """Return the row of a run or a batch."""
    drift, steps, rejected = (
        np.asarray(x)
        for x in (
            jnp.abs(jnp.sum(phases.energy_drift, -1)),
            phases.accepted.sum(-1),
            phases.rejected.sum(-1),
        )
    )
    times = [f"{f(seconds):.3g}" for f in (np.median, min, max)]
    return [
        label,
        who,
        *times,
        f"{simulated / np.median(seconds):.3g}",
        f"{error:.1e}",
        f"{np.median(drift):.1e}",
        int(np.mean(steps)),
        int(np.mean(rejected)),
    ]


def mujoco_steps(chain, state, lanes: int, steps: int):
    """Return (label, function) of MuJoCo's steps, on one core or, for a batch, on all."""
    model, q, v = speed_cases.mujoco_case("high bar", chain, state)
    model.opt.timestep = 5e-3
    return next(speed.mujoco_runs(model, q, np.broadcast_to(v, (lanes, len(v))), lanes, steps))


def single_runs(chain, state):
    """Yield rows of one run of 10 s at rtol 1e-8."""
    make_run = lambda **options: jax.jit(
        lambda s: svkc.simulate(chain, s, 10.0, events=events(8.0, 9.0), **options)
    )
    programs = {
        who: make_run(rtol=1e-8, atol=1e-8, **options)
        for who, options in SINGLE_RUN_METHODS.items()
    }
    reference = make_run(**REFERENCE)(state)
    runs = {who: (lambda f=f: jax.block_until_ready(f(state))) for who, f in programs.items()}
    seconds = speed.time_in_turns(runs | dict([mujoco_steps(chain, state, 1, 2000)]), ROUNDS)
    for who, f in programs.items():
        traj = f(state)
        yield result_row(
            "one", who, seconds[who], 10.0, final_error(chain, traj, reference), traj.phases
        )
    yield [
        "one",
        "MuJoCo",
        *(f"{f(seconds['MuJoCo']):.3g}" for f in (np.median, min, max)),
        f"{10 / np.median(seconds['MuJoCo']):.3g}",
        "",
        "",
        2000,
        0,
    ]


def batch_runs(chain, state, lanes: int, methods: dict, peers=()):
    """Yield rows of batches by `svkc.rollout`. The first call compiles."""
    states = jax.tree.map(lambda x: jnp.broadcast_to(x, (lanes, *x.shape)), state)
    times = 0.3 + 0.6 * jax.random.uniform(jax.random.key(1), (lanes,))
    lane = lambda chain, time: {"events": events(time, time + 0.2)}
    common = {"data": times, "lane": lane, "cost": times, "progress": False, "max_steps": 2048}
    rollouts = {
        who: (lambda options=options: svkc.rollout(chain, states, END, **common, **options))
        for who, options in methods.items()
    }
    runs = {who: (lambda f=f: jax.block_until_ready(f())) for who, f in rollouts.items()}
    seconds = speed.time_in_turns(runs | dict(peers), ROUNDS)
    reference = jax.jit(
        lambda time: svkc.simulate(chain, state, END, **lane(chain, time), **REFERENCE)
    )
    references = [reference(time) for time in times[:REFERENCE_LANES]]
    for who, f in rollouts.items():
        traj = f()
        assert bool(jnp.all(traj.result == svkc.RESULTS.successful)), who
        errors = [
            final_error(chain, jax.tree.map(lambda x, i=i: x[i], traj), references[i])
            for i in range(REFERENCE_LANES)
        ]
        yield result_row(lanes, who, seconds[who], lanes * END, np.median(errors), traj.phases)
    for name, _ in peers:
        x = seconds[name]
        yield [
            lanes,
            name,
            *(f"{f(x):.3g}" for f in (np.median, min, max)),
            f"{lanes * END / np.median(x):.3g}",
            "",
            "",
            round(END / 5e-3),
            0,
        ]


def unequal_runs(chain, state, lanes: int):
    """Yield rows of lanes that end at 0.1 to 1.8 s, unsorted and sorted by duration."""
    states = jax.tree.map(lambda x: jnp.broadcast_to(x, (lanes, *x.shape)), state)
    ends = 0.1 + 1.7 * jax.random.uniform(jax.random.key(2), (lanes,))
    lane = lambda chain, end: {"events": events(end / 2, 0.8 * end), "t1": end}
    roll = lambda cost: svkc.rollout(
        chain, states, END, data=ends, lane=lane, progress=False, max_steps=2048, cost=cost, **TSIT5
    )
    runs = {
        "Tsit5, rtol 1e-4, as they come": lambda: roll(None),
        "Tsit5, rtol 1e-4, sorted": lambda: roll(ends),
    }
    seconds = speed.time_in_turns(
        {who: (lambda f=f: jax.block_until_ready(f())) for who, f in runs.items()}, ROUNDS
    )
    for who, f in runs.items():
        line = result_row(
            f"{lanes}, unequal", who, seconds[who], float(jnp.sum(ends)), 0.0, f().phases
        )
        yield [*line[:6], "", *line[7:]]


def main(lanes: int):
    """Measure, print and write all rows."""
    chain, state = speed_cases.load_case("high bar")
    table, machine = [], speed.machine()
    print("| " + " | ".join(HEAD) + " |")
    tables = (
        single_runs(chain, state),
        batch_runs(
            chain,
            state,
            lanes,
            BATCH_METHODS,
            [mujoco_steps(chain, state, lanes, round(END / 5e-3))],
        ),
        batch_runs(*svkc.scenes.high_bar(), lanes, BATCH_METHODS_WITH_RANGES),
        unequal_runs(chain, state, lanes // 4),
    )
    for rows in tables:
        for line in rows:
            table.append(line)
            print("| " + " | ".join(map(str, line)) + " |", flush=True)
        with (speed.RESULTS / "runs.csv").open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(
                [[*HEAD, *machine], *([*line, *machine.values()] for line in table)]
            )
    print(machine)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--lanes", type=int, default=4096)
    main(parser.parse_args().lanes)
