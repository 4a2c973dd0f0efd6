"""The commands `info`, of a model, and `view`, of a saved run."""

import pathlib
import webbrowser

import numpy as np

from svkc.cli.printing import print_error, print_report


def info(path: str, ignore: tuple[str, ...] = ()) -> int:
    """Print what svkc reads from a model file, and return the exit status.

    path: MJCF or URDF file.
    ignore: kinds of elements to leave out, as in `svkc.load`. If it is empty, unsupported elements
        are named and left out.
    """
    import svkc
    from svkc._jax.compilation_cache import use_cache

    cache_folder = use_cache()
    try:
        chain = svkc.load(path, ignore=ignore)
    except ValueError as error:
        print_error(error, f"svkc info {path}", ignore)
        if ignore or not hasattr(error, "kinds"):
            return 1
        chain = svkc.load(path, ignore="all")
    state = chain.state() if not len(chain.link_names) else _load_state(chain)
    print(chain)
    if state is not None:
        print(f"as loaded:\n{svkc.mobility(chain, state)}")
    for line in chain.left_out:
        print(f"left out: {line}")
    _print_suggestions(chain)
    print(
        f"compiled programs: {cache_folder or 'not kept'}"
        " (SVKC_CACHE_DIR names another folder, or off)"
    )
    return 0


def _load_state(chain):
    """Return the state nearest to the load pose.

    If the loops cannot be closed, print the error and return None.
    """
    try:
        return chain.state()
    except ValueError as error:
        print(error)
        return None


def _print_suggestions(chain):
    """Print which joints can be cut, and which leaf bodies of the tree could be held."""
    from svkc.mjcf.cuttable_joints import cuttable_joints

    def can_be_cut(name):
        try:
            return bool(cuttable_joints(chain.model.model, [name]))
        except ValueError:
            return False

    parents = {int(p) for p in chain.model.model.body_parentid[1:]}
    leaf_bodies = [name for i, name in enumerate(chain.body_names) if i and i not in parents]
    print(
        "joints that can be cut, load(..., cuttable=[...]):"
        f" {', '.join(filter(can_be_cut, chain.joint_names)) or 'none'}"
    )
    print(
        "ends of the tree, which could be held: "
        + ", ".join(leaf_bodies[:12])
        + ", ..." * (len(leaf_bodies) > 12)
    )
    if leaf_bodies:
        print(
            f'  svkc.VirtualLink("grip", "world", "{leaf_bodies[0]}", joint="ball"), or'
            " load(..., spare=1) and svkc.bind while it moves"
        )


def view(path: pathlib.Path, show: bool) -> int:
    """Print the report of a saved run, draw its page and curves, and return the exit status.

    path: a file written by `traj.save(path, chain)`. The pictures are written beside it.
    show: whether to open the page in a browser.
    """
    import jax

    # runs saved in float64 are loaded in float64
    jax.config.update("jax_enable_x64", True)
    import svkc
    from svkc._jax.compilation_cache import use_cache

    use_cache()
    try:
        chain, traj = svkc.load_chain(path), svkc.load_trajectory(path)
    except (ValueError, OSError) as error:
        print(error)
        return 1
    if np.ndim(traj.t_final):
        print(traj)
        print("a picture shows one run: draw one lane, such as svkc.render(chain, traj[0], path)")
        return 0
    print_report(traj)
    written, failures = [], []
    for target, write in (
        (path.with_suffix(".html"), lambda p: svkc.render(chain, traj, p)),
        (path.with_name(f"{path.stem}_curves.png"), lambda p: traj.plot(chain).savefig(p)),
    ):
        try:
            write(target)
            written.append(target)
        except (ImportError, RuntimeError, ValueError) as error:
            failures.append(f"{target.name} not drawn: {error}")
    print("\n".join([*failures, "wrote " + (", ".join(map(str, written)) or "nothing")]))
    if show and written:
        webbrowser.open(written[0].resolve().as_uri())
    return 0
