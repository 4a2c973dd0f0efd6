"""Commands that run a scene or a model.

jax is imported where it is used, so that `--help` is fast.
"""

import gc
import itertools
import pathlib
import time

RELEASE_RIGHT, RELEASE_LEFT = 0.9, 1.15  # s
TOLERANCES = {"rtol": 1e-8, "atol": 1e-10}


def _high_bar():
    import svkc
    from svkc.scenes import high_bar

    return *high_bar(), (
        svkc.at(RELEASE_RIGHT, cut="right_hand_grip"),
        svkc.at(RELEASE_LEFT, cut="left_hand_grip"),
    )


def _swing():
    from svkc.scenes.swing import seat_events, swing

    chain, state = swing()
    return chain, state, seat_events(chain)


def _brachiation():
    from svkc.scenes.brachiation import brachiation

    return *brachiation(), ()


def _walking():
    from svkc.scenes.walking import walking

    return *walking(), ()


# name: function that returns chain, state and events; end time (s); description
SCENES = {
    "high_bar": (_high_bar, 1.8, "two hands on a bar, one, flight (the paper's Fig. 20)"),
    "swing": (_swing, 2.0, "the seat of a swing gives way as the thighs slide off (Fig. 21)"),
    "brachiation": (
        _brachiation,
        1.0,
        "hangs from the first of three bars; nobody drives it (examples/03_brachiation.py does)",
    ),
    "walking": (
        _walking,
        0.6,
        (
            "stands on two feet and falls, only its feet held by the ground; nobody drives it"
            " (examples/04_walk.py does)"
        ),
    ),
}


def scenes() -> int:
    """Print the scenes that ship; return the exit status."""
    width = max(map(len, SCENES))
    for name, (_, end, what) in SCENES.items():
        print(f"{name:<{width}}  {end:.1f} s  {what}")
    print("run one:  svkc run NAME")
    return 0


def run(
    name: str, *, t1: float | None, events, ignore, out: pathlib.Path, video: bool, quiet: bool
) -> int:
    """Run one scene or model, print its report, write its pictures; return the exit status.

    events: (kind, link, time), which replace the scene's own.
    """
    cache_folder = _configure_process()
    import svkc

    times = [time.perf_counter()]
    progress = _progress_bar(quiet)
    try:
        chain, state, events, end = _prepare_run(name, t1, events, ignore)
        out.mkdir(parents=True, exist_ok=True)
        times.append(time.perf_counter())
        _next_stage(progress, "compiling, and the first run")
        _simulate(chain, state, events, end, progress.disable)
    except (ValueError, OSError) as error:
        progress.close()
        print(error)
        return 1
    times.append(time.perf_counter())
    _next_stage(progress, "a run")
    traj = _simulate(chain, state, events, end, progress.disable)
    times.append(time.perf_counter())
    _next_stage(progress, "pictures")
    options = {**TOLERANCES, "t1": end, "what": name}
    written, missing = _write_results(chain, traj, out, pathlib.Path(name).stem, video, options)
    _next_stage(progress, "done")
    progress.close()
    print_report(chain, traj)
    _print_times(times, cache_folder)
    _print_files(written, missing)
    # a run that ended early is written as well; the exit status tells the shell
    return 0 if traj.result in (svkc.RESULTS.successful, svkc.RESULTS.stopped) else 1


def _configure_process() -> pathlib.Path | None:
    """Configure jax and the garbage collector; return the folder of compiled programs."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from svkc._jax.compilation_cache import use_cache

    cache_folder = use_cache()
    # tracing makes very many small objects that stay, which the collector would scan repeatedly
    gc.freeze()
    gc.set_threshold(100_000, 20, 50)
    return cache_folder


def _progress_bar(quiet: bool):
    """Return the progress bar of the command's four stages."""
    from tqdm import tqdm

    return tqdm(
        total=4,
        desc="loading",
        bar_format="{l_bar}{bar:20}| {elapsed}",
        disable=True if quiet else None,
        leave=False,
    )


def _print_times(times: list[float], cache_folder: pathlib.Path | None):
    """Print the seconds of loading, of the first run and of a second run, and the cache folder.

    times: four clock readings.
    """
    load, first, second = (b - a for a, b in itertools.pairwise(times))
    print(
        f"load and close the loops {load:.1f} s, first run with compilation"
        f" {first:.1f} s, a run {second:.3f} s"
    )
    if cache_folder is not None:
        print(f"compiled programs are kept in {cache_folder}")


def _print_files(written: list[pathlib.Path], missing: list[str]):
    """Print which pictures failed, which files were written, and how to open them."""
    print("\n".join(missing) + "\n" * bool(missing) + "wrote " + ", ".join(map(str, written)))
    print(
        f"look: open {written[-1]}"
        + f", or  svkc view {written[0]}" * (written[-1].suffix == ".html")
    )


def _simulate(chain, state, events, end: float, quiet: bool):
    """Run the scene and wait for the result. Runs longer than 10 s show their progress."""
    import diffrax
    import jax
    import jax.numpy as jnp

    import svkc

    ts = jnp.linspace(0, end, max(round(end / 0.025), 1) + 1)
    meter = None if quiet or end <= 10 else diffrax.TqdmProgressMeter()
    return jax.block_until_ready(
        svkc.simulate(
            chain, state, end, ts=ts, events=events, throw=False, progress_meter=meter, **TOLERANCES
        )
    )


def _next_stage(progress, description: str):
    """Advance the progress bar to the next stage."""
    progress.update()
    progress.set_description(description)


def _prepare_run(name: str, t1: float | None, events, ignore):
    """Return chain, state, events and end time for the arguments of the command."""
    from svkc.model.validation import positive_scalar

    chain, state, scene_events, end = _load_scene(name, ignore)
    end = end if t1 is None else t1
    positive_scalar("--t1", end)
    return chain, state, _requested_events(chain, events) or scene_events, end


def _load_scene(name: str, ignore):
    """Return chain, state, events and end time of a scene or of a model file.

    A model file starts at its load pose and runs for two seconds.
    """
    import svkc

    if name in SCENES:
        make, end, _ = SCENES[name]
        return *make(), end
    if not pathlib.Path(name).is_file():
        raise ValueError(f"run: no scene and no file {name!r}; scenes: {', '.join(SCENES)}")
    chain = svkc.load(name, ignore=ignore)
    return chain, chain.state(), (), 2.0


def _requested_events(chain, events):
    """Return the events of `--release` and `--catch`."""
    import svkc

    for _, link, _ in events:
        if link not in chain.link_names:
            raise ValueError(
                f"run: no virtual link {link!r}; virtual links:"
                f" {', '.join(chain.link_names) or 'none'}"
            )
    return tuple(
        svkc.at(t, cut=link) if kind == "release" else svkc.at(t, connect=link, here=True)
        for kind, link, t in events
    )


def _write_results(
    chain, traj, out: pathlib.Path, stem: str, video: bool, options: dict
) -> tuple[list, list[str]]:
    """Save the run and draw its pictures.

    Return the files written, and a message for each failure.
    """
    import svkc

    written, missing = [out / f"{stem}.npz"], []
    traj.save(written[0], chain, **options)
    curves = lambda path: traj.plot(chain).savefig(path, dpi=110)
    draw = lambda path: svkc.render(chain, traj, path, azimuth=90)
    pictures = [
        (f"{stem}.png", draw),
        (f"{stem}_curves.png", curves),
        (f"{stem}.gif", draw),
        (f"{stem}.mp4", draw),
        (f"{stem}.html", draw),
    ]
    for file, write in pictures:
        if file.endswith(".mp4") and not video:
            continue
        try:
            write(out / file)
            written.append(out / file)
        except (RuntimeError, ImportError) as error:
            missing.append(f"{file} not drawn: {error}")
    return written, missing


def print_report(chain, traj):
    """Print a table of the phases, the event times, and the run's report."""
    p, report = traj.phases, traj.report()
    names = {
        i: (
            ", ".join(n for n, on in zip(chain.link_names, p.connected[i], strict=True) if on)
            or "nothing"
        )
        for i in range(int(p.count))
    }
    width = max(34, *map(len, names.values()))
    print(
        f"      from        to  {'held by':<{width}} joint   rank  mobility   steps  energy drift"
    )
    print(f"         s         s  {'':<{width}} freedoms                           J")
    for i in range(int(p.count)):
        if float(p.start[i]) == float(p.stop[i]) and i:
            continue
        print(
            f"{float(p.start[i]):10.6f}{float(p.stop[i]):10.6f} "
            f" {names[i]:<{width}}{int(p.joint_freedoms[i]):6d}{int(p.rank[i]):7d}"
            f"{int(p.freedoms[i]):10d}{int(p.accepted[i]):8d}{float(p.energy_drift[i]):14.2e}"
        )
    times = ", ".join(f"{float(t):.6f} s" for t in traj.events.time[: int(traj.events.count)])
    print(f"events at {times or 'no time'}; energy at the start {float(p.energy[0, 0]):.3f} J")
    print(report)
