"""F7: the command line. `python -m svkc` runs the high bar: two hands, one hand, flight; `python -m svkc swing` the swing."""

import argparse
import pathlib
import sys
import time

RELEASE_RIGHT, RELEASE_LEFT, END, SWING_END = 0.9, 1.15, 1.8, 2.0  # s


def _info(path: str) -> int:
    """What a model is to svkc."""
    import svkc

    try:
        chain = svkc.load(path)
    except ValueError as error:
        print(error)
        if "not simulated" not in str(error):
            return 1
        chain = svkc.load(path, ignore="all")
    state = chain.state() if not len(chain.link_names) else _state_or_none(chain)
    print(f"{len(chain.body_names) - 1} bodies: {', '.join(chain.body_names[1:])}")
    print(f"{len(chain.joint_names)} joints: {', '.join(chain.joint_names)}")
    print(f"{len(chain.link_names)} virtual links: {', '.join(chain.link_names) or 'none'}")
    print(f"{chain.nv} joint freedoms in the tree, {chain.dofs} with every virtual link; {chain.gear.shape[0]} actuators")
    if state is not None:
        print(f"as loaded:\n{svkc.mobility(chain, state)}")
    for line in chain.left_out:
        print(f"left out: {line}")
    return 0


def _state_or_none(chain):
    try:
        return chain.state()
    except ValueError as error:
        print(error)
        return None


def _high_bar():
    """Two hands, one hand, flight: Fig. 20."""
    import svkc
    from svkc.scenes import high_bar

    return *high_bar(), (svkc.at(RELEASE_RIGHT, cut="right_hand_grip"), svkc.at(RELEASE_LEFT, cut="left_hand_grip")), END


def _swing():
    """A swing whose seat gives way: Fig. 21."""
    from svkc.scenes.swing import leaving, swing

    chain, state = swing()
    return chain, state, leaving(chain), SWING_END


SCENES = {"high_bar": _high_bar, "swing": _swing}


def _run(name: str, out: pathlib.Path) -> int:
    """One scene: the table of its phases, the run, the pictures."""
    import jax

    # the process is the command's own, so the setting is too
    jax.config.update("jax_enable_x64", True)
    import jax.numpy as jnp

    import svkc

    begin = time.perf_counter()
    chain, state, events, end = SCENES[name]()
    loaded = time.perf_counter()
    ts = jnp.linspace(0, end, round(end / 0.025) + 1)

    def run():
        return jax.block_until_ready(svkc.simulate(chain, state, end, ts=ts, events=events, rtol=1e-8, atol=1e-10))

    traj = run()
    compiled = time.perf_counter()
    traj = run()
    done = time.perf_counter()
    _print_phases(chain, traj)
    print(f"load and close the loops {loaded - begin:.1f} s, first run with compilation {compiled - loaded:.1f} s, a run {done - compiled:.3f} s")
    out.mkdir(parents=True, exist_ok=True)
    traj.save(out / f"{name}.npz", chain)
    written = [out / f"{name}.npz"]
    for file, missing in ((f"{name}.png", "matplotlib"), (f"{name}.gif", "a GL library")):
        try:
            written.append(svkc.render(chain, traj, out / file, azimuth=90))
        except (RuntimeError, ImportError) as error:
            print(f"{file} not drawn, {missing} is missing: {error}")
    print("wrote " + ", ".join(str(p) for p in written))
    return 0


def _print_phases(chain, traj):
    """Freedoms, rank, mobility, steps and energy before and after each event, then the certificate."""
    p, report = traj.phases, traj.report()
    names = {i: ", ".join(n for n, on in zip(chain.link_names, p.connected[i], strict=True) if on) or "nothing" for i in range(int(p.count))}
    wide = max(34, *map(len, names.values()))
    print(f"      from        to  {'held by':<{wide}} joint   rank  mobility   steps  energy drift")
    print(f"         s         s  {'':<{wide}} freedoms                           J")
    for i in range(int(p.count)):
        if float(p.start[i]) == float(p.stop[i]) and i:
            continue
        print(
            f"{float(p.start[i]):10.6f}{float(p.stop[i]):10.6f}  {names[i]:<{wide}}{int(p.joint_freedoms[i]):6d}{int(p.rank[i]):7d}"
            f"{int(p.freedoms[i]):10d}{int(p.accepted[i]):8d}{float(p.energy_drift[i]):14.2e}"
        )
    times = ", ".join(f"{float(t):.6f} s" for t in traj.events.time[: int(traj.events.count)])
    print(f"events at {times}; energy at the start {float(p.energy[0, 0]):.3f} J")
    print(report)


def main(argv=None) -> int:
    """Entry point."""
    parser = argparse.ArgumentParser("svkc", description="Structure-varying kinematic chains: the high bar, release and all.")
    parser.add_argument("command", nargs="?", default="high_bar", choices=[*SCENES, "info"], help="a scene, or info MODEL: what a model is to svkc")
    parser.add_argument("model", nargs="?", help="MJCF or URDF file")
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out"), help="folder for results (default: out)")
    options = parser.parse_args(argv)
    if options.command == "info":
        if options.model is None:
            parser.error("info needs a model file")
        return _info(options.model)
    return _run(options.command, options.out)


if __name__ == "__main__":
    sys.exit(main())
