"""Growth of cost and memory with links, loops, lanes, simulated time and events; fitted exponents.

`python benchmarks/scaling.py [links loops lanes time events]` (extra `bench`) prints and writes
results/scaling.csv and draws results/scaling.png. Rows hold microseconds per `svkc.step` (links,
loops, lanes) or milliseconds per run of `svkc.simulate` (time, events), medians; seconds of
tracing, lowering and compilation; megabytes of temporary memory. MuJoCo's `mj_step` is measured for
links.
"""

import argparse
import csv

import speed  # first: sets XLA_FLAGS, and the path to the tests

# isort: split
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import speed_cases
from programs import Program, scan_steps
from speed import RESULTS

import svkc

HEAD = [
    "what grows",
    "to",
    "unit",
    "median",
    "least",
    "most",
    "MuJoCo",
    "trace s",
    "lower s",
    "compile s",
    "temporary MB",
]
LINK = (
    '<body name="b{0}" pos="0 0 {1}"><joint name="j{0}" type="{2}" {3}/><geom type="capsule"'
    ' fromto="0 0 0 0 0 -0.1" size="0.02" mass="0.1"/>{4}</body>'
)


def chain_of(count: int, balls: bool = False) -> str:
    """Return MJCF of bars in a row, on hinges with alternating axes or on balls."""
    text = ""
    for i in reversed(range(count)):
        kind, axis = (
            ("ball", "") if balls else ("hinge", f'axis="{i % 2} {(i + 1) % 2} 0" damping="0.01"')
        )
        text = LINK.format(i, -0.1 if i else 0, kind, axis, text)
    return (
        f'<mujoco><option timestep="{speed_cases.DT}"><flag'
        f' contact="disable"/></option><worldbody>{text}</worldbody></mujoco>'
    )


def step_program(chain, state, batch: int = 1):
    """Return the number of steps in one call, and their program."""
    steps, tau = speed.steps_for(batch), jnp.zeros(chain.nv)
    step = lambda s: svkc.step(chain, s, tau, speed_cases.DT)
    return steps * batch, Program(scan_steps(step if batch == 1 else jax.vmap(step), steps), state)


def links():
    """Yield open chains of 5 to 200 bars."""
    for count in (5, 10, 20, 50, 100, 200):
        chain = svkc.load(chain_of(count))
        state = chain.state(np.full(count, 0.1))
        steps, program = step_program(chain, state)
        model, data = chain.model.model, mujoco.MjData(chain.model.model)

        def peer(model=model, data=data, state=state, steps=steps):
            mujoco.mj_resetData(model, data)
            data.qpos[:] = state.q
            mujoco.mj_step(model, data, steps)

        yield count, "us a step", 1e6 / steps, {"svkc": program, "MuJoCo": peer}


def loops():
    """Yield forty bars on balls, with 1 to 20 of them connected to the ground by balls."""
    for count in (1, 2, 5, 10, 20):
        pins = [
            svkc.VirtualLink(
                f"pin{i}", "world", f"b{40 * (i + 1) // count - 1}", "ball", real_pos=(0, 0, -0.1)
            )
            for i in range(count)
        ]
        chain = svkc.load(chain_of(40, balls=True), virtual_links=pins)
        state = svkc.connect(chain, chain.state(connected=()), *chain.link_names, here=True)
        steps, program = step_program(chain, state)
        yield count, "us a step", 1e6 / steps, {"svkc": program}


def lanes():
    """Yield batches of 256 to 16384 open figures of 46 freedoms."""
    chain, state = speed_cases.load_case("open")
    for batch in (256, 1024, 4096, 16384):
        steps, program = step_program(chain, speed_cases.random_states(chain, state, batch), batch)
        yield batch, "us a step and lane", 1e6 / steps, {"svkc": program}


def time():
    """Yield the high bar without releases, for 0.5 to 8 s."""
    chain, state = speed_cases.load_case("high bar")
    for end in (0.5, 1.0, 2.0, 4.0, 8.0):
        yield (
            end,
            "ms a run",
            1e3,
            {
                "svkc": Program(
                    lambda s, end=end: svkc.simulate(chain, s, end, throw=False).final, state
                )
            },
        )


def events():
    """Yield a pendulum for 2 s whose pin is cut and connected 1 to 64 times."""
    chain = svkc.load(chain_of(1), cuttable="j0")
    state = chain.state({"j0": 1.0})
    for count in (1, 4, 16, 64):
        when = [
            svkc.at(
                2 * (i + 1) / (count + 1),
                **({"connect": "j0", "here": True} if i % 2 else {"cut": "j0"}),
            )
            for i in range(count)
        ]
        run = lambda s, when=when, count=count: (
            svkc.simulate(chain, s, 2.0, events=when, max_events=count, throw=False).final
        )
        yield count, "ms a run", 1e3, {"svkc": Program(run, state)}


GROWTH = {f.__name__: f for f in (links, loops, lanes, time, events)}


def draw(table):
    """Draw a panel for each growing quantity."""
    import matplotlib.pyplot as plt
    from matplotlib.ticker import NullFormatter

    names = list(dict.fromkeys(row[0] for row in table))
    figure, axes = plt.subplots(
        1, len(names), figsize=(3.2 * len(names), 3), layout="constrained", squeeze=False
    )
    for ax, name in zip(axes[0], names):
        rows = [row for row in table if row[0] == name]
        ax.loglog(
            [float(row[1]) for row in rows], [float(row[3]) for row in rows], "o-", label="svkc"
        )
        if rows[0][6]:
            ax.loglog(
                [float(row[1]) for row in rows],
                [float(row[6]) for row in rows],
                "s:",
                label="MuJoCo",
            )
            ax.legend(fontsize=8)
        low, high = ax.get_ylim()
        ax.set(xlabel=name, ylabel=rows[0][2], ylim=(min(low, high / 10), high * 1.1))
        ax.xaxis.set_minor_formatter(NullFormatter())
        ax.grid(alpha=0.3)
    figure.savefig(RESULTS / "scaling.png", dpi=110)


def main(names):
    """Measure, fit, print and write the named quantities."""
    table = []
    print("| " + " | ".join(HEAD) + " |")
    for name in names:
        first = len(table)
        for size, unit, scale, runs in GROWTH[name]():
            seconds = {who: x * scale for who, x in speed.time_in_turns(runs).items()}
            ours, peer = seconds["svkc"], seconds.get("MuJoCo")
            compile_columns = [f"{value:.2f}" for value in runs["svkc"].compile_stats]
            table.append(
                [
                    name,
                    size,
                    unit,
                    *(f"{f(ours):.3g}" for f in (np.median, min, max)),
                    "" if peer is None else f"{np.median(peer):.3g}",
                    *compile_columns,
                ]
            )
            print("| " + " | ".join(map(str, table[-1])) + " |", flush=True)
        log_x, log_costs = (np.log([float(row[i]) for row in table[first:]]) for i in (1, 3))
        print(
            f"{name}: exponent {np.polyfit(log_x, log_costs, 1)[0]:.2f} over all,"
            f" {np.polyfit(log_x[-3:], log_costs[-3:], 1)[0]:.2f} over the last three",
            flush=True,
        )
    with (RESULTS / "scaling.csv").open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(
            [[*HEAD, *speed.machine()], *([*row, *speed.machine().values()] for row in table)]
        )
    draw(table)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("names", nargs="*", metavar="name", help=f"of {', '.join(GROWTH)}")
    main(parser.parse_args().names or GROWTH)
