"""Numbers of files and moves between files in following one object through the code.

Four walks: a `State` through `simulate`, a `VirtualLink` from `load` to the loop Jacobian, a guard
from `when` to the derivative of its time, a torque through forward dynamics. A walk is the list of
svkc's functions in the order in which the interpreter first calls them. The table holds files
entered, moves between files, moves back to a file left before, and packages.

`python benchmarks/walks.py`; with PYTHONPATH set to another checkout, its walks.
"""

import pathlib
import sys

import jax
import jax.numpy as jnp

import svkc

ROOT = pathlib.Path(svkc.__file__).parent
HAND = """<mujoco><worldbody><body name="arm"><joint name="arm" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -1" size="0.03" contype="0"/>
<body name="hand" pos="0 0 -1"><joint name="hand" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.03" contype="0"/></body></body>
</worldbody></mujoco>"""


def record_files(call) -> list[str]:
    """Return the file of each function of svkc, in the order of first calls."""
    entered, files = set(), []

    def enter(frame, event, _):
        code = frame.f_code
        if event == "call" and code not in entered and code.co_filename.startswith(str(ROOT)):
            entered.add(code)
            files.append(str(pathlib.Path(code.co_filename).relative_to(ROOT)))

    jax.clear_caches()
    sys.setprofile(enter)
    try:
        call()
    finally:
        sys.setprofile(None)
    return files


def count_moves(files: list[str]) -> tuple[int, int, int, int]:
    """Return files entered, moves between files, returns to a file already left, packages."""
    moves = [b for a, b in zip(files, files[1:], strict=False) if a != b]
    returns = len(moves) - len(set(moves) - {files[0]})
    packages = {file.split("/")[0] for file in files if "/" in file}
    return len(set(files)), len(moves), returns, len(packages)


def load():
    """Return a two-link arm whose hand is connected to the ground by a pin."""
    pin = svkc.VirtualLink(
        "pin", "world", "hand", "hinge", pos=(0.5, 0, -1), axis=(0, 1, 0), connected=True
    )
    return svkc.load(HAND, virtual_links=[pin])


def main():
    """Print the table."""
    jax.config.update("jax_enable_x64", True)
    chain = load()
    state = chain.state()
    free = chain.state({"arm": 0.3}, connected=())
    release = svkc.at(0.02, cut=["pin"])

    def event_time(height):
        guard = lambda t, state, args: svkc.poses(chain, state)[0][-1, 0] - args
        event = svkc.when(guard)
        run = svkc.simulate(chain, free, 0.5, events=[event], args=height, dt=1e-2)
        return run.events.time[0]

    walks = {
        "a State through simulate": lambda: svkc.simulate(
            chain, state, 0.05, events=[release], dt=1e-2
        ),
        "a VirtualLink, from load to the loop Jacobian": lambda: svkc.loop_jacobian(load(), state),
        "a guard, from when to the derivative of its time": lambda: jax.grad(event_time)(
            jnp.asarray(-0.4)
        ),
        "a torque through forward dynamics": lambda: svkc.forward_dynamics(
            chain, state, jnp.zeros(chain.dofs)
        ),
    }
    print("| walk | files | moves | returns | packages |")
    print("|---|---|---|---|---|")
    for name, call in walks.items():
        print(f"| {name} | {' | '.join(map(str, count_moves(record_files(call))))} |", flush=True)


if __name__ == "__main__":
    main()
