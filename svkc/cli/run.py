"""The commands `run`, of a scene or a model, and `scenes`.

Functions import jax when called, so that `--help` is fast.
"""

import gc
import itertools
import pathlib
import time
from typing import Any

from svkc.cli.printing import print_error, print_report

RELEASE_RIGHT, RELEASE_LEFT = 0.9, 1.15  # s
TOLERANCES: dict[str, Any] = {"rtol": 1e-8, "atol": 1e-10}


def _high_bar():
    """Return chain, state and events of the main job: one hand releases the bar, then the other."""
    import svkc
    from svkc.scenes import high_bar

    return *high_bar(), (
        svkc.at(RELEASE_RIGHT, cut="right_hand_grip"),
        svkc.at(RELEASE_LEFT, cut="left_hand_grip"),
    )


def _swing():
    """Return chain, state and events of the swing."""
    from svkc.scenes.swing import seat_events, swing

    chain, state = swing()
    return chain, state, seat_events(chain)


def _brachiation():
    """Return chain, state and no events of the figure under three bars."""
    from svkc.scenes.brachiation import brachiation

    return *brachiation(), ()


def _walking():
    """Return chain, state and no events of the standing figure."""
    from svkc.scenes.walking import walking

    return *walking(), ()


# name: function that returns chain, state and events; end time (s); description
SCENES = {
    "high_bar": (_high_bar, 1.8, "two hands on a bar, one, flight (the paper's Fig. 20)"),
    "swing": (_swing, 2.0, "the seat of a swing gives way as the thighs slide off (Fig. 21)"),
    "brachiation": (
        _brachiation,
        1.0,
        "hangs from the first of three bars, without control (examples/03_brachiation.py has one)",
    ),
    "walking": (
        _walking,
        0.6,
        (
            "stands on two feet and falls, its feet held by the ground, without control"
            " (examples/04_walk.py has one)"
        ),
    ),
}


def scenes() -> int:
    """Print name, duration and description of each scene, and return the exit status."""
    width = max(map(len, SCENES))
    for name, (_, end, description) in SCENES.items():
        print(f"{name:<{width}}  {end:.1f} s  {description}")
    print("run one:  svkc run NAME")
    return 0


def run(
    name: str, *, t1: float | None, events: Any, ignore: Any, out: pathlib.Path, video: bool,
    quiet: bool,
) -> int:  # fmt: skip
    """Run a scene or a model, print its report, write its files, and return the exit status.

    name: name of a scene, or path of a model.
    t1: end time (s). None: that of the scene.
    events: (kind, link, time (s)) of each `--release` and `--catch`, in place of the scene's own.
    ignore: kinds of model elements to leave out.
    out: folder for the files.
    video: whether to write an mp4. quiet: whether to show no progress bar.
    """
    cache_folder = _configure_process()
    import svkc

    clock = [time.perf_counter()]
    progress = _progress_bar(quiet)
    try:
        chain, state, events, end = _prepare_run(name, t1, events, ignore)
        out.mkdir(parents=True, exist_ok=True)
        clock.append(time.perf_counter())
        _next_stage(progress, "compiling, and the first run")
        _simulate(chain, state, events, end, progress.disable)
    except (ValueError, OSError) as error:
        progress.close()
        print_error(error, f"svkc run {name}", ignore)
        return 1
    clock.append(time.perf_counter())
    _next_stage(progress, "a run")
    traj = _simulate(chain, state, events, end, progress.disable)
    clock.append(time.perf_counter())
    _next_stage(progress, "pictures")
    options = {**TOLERANCES, "t1": end, "what": name}
    written, failures = _write_results(chain, traj, out, pathlib.Path(name).stem, video, options)
    _next_stage(progress, "done")
    progress.close()
    print_report(traj)
    _print_times(clock, cache_folder)
    _print_files(written, failures)
    # a run that ended early is written as well; the exit status tells the shell
    return 0 if traj.result in (svkc.RESULTS.successful, svkc.RESULTS.stopped) else 1


def _configure_process() -> pathlib.Path | None:
    """Enable x64 and the compilation cache, and return the folder of the cache.

    Garbage collection is made less frequent.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    from svkc._jax.compilation_cache import use_cache

    cache_folder = use_cache()
    # the collector would repeatedly scan the many small objects that tracing leaves
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


def _print_times(clock: list[float], cache_folder: pathlib.Path | None):
    """Print the seconds of loading, of the first run and of a second run, and the cache folder.

    clock: the times (s) at which loading starts and each of the three ends.
    """
    load, first, second = (b - a for a, b in itertools.pairwise(clock))
    print(
        f"load and close the loops {load:.1f} s, first run with compilation"
        f" {first:.1f} s, a run {second:.3f} s"
    )
    if cache_folder is not None:
        print(f"compiled programs are kept in {cache_folder}")


def _print_files(written: list[pathlib.Path], failures: list[str]):
    """Print the failures, the files that were written, and how to open them."""
    print("\n".join(failures) + "\n" * bool(failures) + "wrote " + ", ".join(map(str, written)))
    print(
        f"look: open {written[-1]}"
        + f", or  svkc view {written[0]}" * (written[-1].suffix == ".html")
    )


def _simulate(chain, state, events, end: float, quiet: bool):
    """Return the trajectory up to `end` (s). Runs of more than 10 s show their progress."""
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
    """Advance the progress bar by one stage and show the description of the next one."""
    progress.update()
    progress.set_description(description)


def _prepare_run(name: str, t1: float | None, events, ignore):
    """Return chain, state, events and end time (s) for the arguments of the command."""
    from svkc.model.validation import positive_scalar

    chain, state, scene_events, end = _load_scene(name, ignore)
    end = end if t1 is None else t1
    positive_scalar("--t1", end)
    return chain, state, _requested_events(chain, events) or scene_events, end


def _load_scene(name: str, ignore):
    """Return chain, state, events and end time (s) of a scene or of a model file.

    A model starts at its load pose and runs for two seconds.
    """
    import svkc

    if name in SCENES:
        if ignore:
            raise ValueError(f"run: --ignore is for model files, and {name!r} is a scene")
        build, end, _ = SCENES[name]
        return *build(), end
    if not pathlib.Path(name).is_file():
        raise ValueError(f"run: no scene and no file {name!r}; scenes: {', '.join(SCENES)}")
    chain = svkc.load(name, ignore=ignore)
    return chain, chain.state(), (), 2.0


def _requested_events(chain, events):
    """Return the events that `--release` and `--catch` describe."""
    import svkc
    from svkc.model.names import unknown_name

    for _, link, _ in events:
        if link not in chain.link_names:
            raise unknown_name("virtual link", link, chain.link_names)
    return tuple(
        svkc.at(t, cut=link) if kind == "release" else svkc.at(t, connect=link, here=True)
        for kind, link, t in events
    )


def _write_results(
    chain, traj, out: pathlib.Path, stem: str, video: bool, options: dict
) -> tuple[list, list[str]]:
    """Save the run and draw its pictures. Return the files written, and a message per failure.

    stem: name of each file, without its suffix.
    options: the run's options, which are saved with it.
    """
    import svkc

    written, failures = [out / f"{stem}.npz"], []
    traj.save(written[0], chain, **options)
    curves = lambda path: traj.plot(chain).savefig(path, dpi=110)
    draw = lambda path: svkc.render(chain, traj, path)
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
            failures.append(f"{file} not drawn: {error}")
    return written, failures
