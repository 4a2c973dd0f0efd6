"""Commands that inspect a model or a saved run."""

import pathlib
import webbrowser

from svkc.cli.run import print_report


def info(path: str) -> int:
    """Print what svkc reads from a model; return the exit status."""
    import svkc
    from svkc._jax.compilation_cache import use_cache

    cache_folder = use_cache()
    try:
        chain = svkc.load(path)
    except ValueError as error:
        print(error)
        if "not simulated" not in str(error):
            return 1
        chain = svkc.load(path, ignore="all")
    state = chain.state() if not len(chain.link_names) else _load_state(chain)
    print(f"{len(chain.body_names) - 1} bodies: {', '.join(chain.body_names[1:])}")
    print(f"{len(chain.joint_names)} joints: {', '.join(chain.joint_names)}")
    print(f"{len(chain.link_names)} virtual links: {', '.join(chain.link_names) or 'none'}")
    print(
        f"{chain.nv} joint freedoms in the tree, {chain.dofs} with every virtual link;"
        f" {chain.gear.shape[0]} actuators"
    )
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
    """Return the state at the load pose.

    If the loops cannot be closed, print the reason and return None.
    """
    try:
        return chain.state()
    except ValueError as error:
        print(error)
        return None


def _print_suggestions(chain):
    """Print which joints can be cut, and which bodies at the ends of the tree could be held."""
    from svkc.mjcf.cuttable_joints import cuttable_joints

    def cut(name):
        try:
            return bool(cuttable_joints(chain.model.model, [name]))
        except ValueError:
            return False

    parents = {int(p) for p in chain.model.model.body_parentid[1:]}
    ends = [name for i, name in enumerate(chain.body_names) if i and i not in parents]
    print(
        "joints that can be cut, load(..., cuttable=[...]):"
        f" {', '.join(filter(cut, chain.joint_names)) or 'none'}"
    )
    print(
        "ends of the tree, which could be held: "
        + ", ".join(ends[:12])
        + ", ..." * (len(ends) > 12)
    )
    if ends:
        print(
            f'  svkc.VirtualLink("grip", "world", "{ends[0]}", joint="ball"), or load(..., spare=1)'
            " and svkc.bind while it moves"
        )


def view(path: pathlib.Path, show: bool) -> int:
    """Print and draw a run that was saved with its chain; return the exit status.

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
    print_report(chain, traj)
    written, missing = [], []
    for target, write in (
        (path.with_suffix(".html"), lambda p: svkc.render(chain, traj, p)),
        (path.with_name(f"{path.stem}_curves.png"), lambda p: traj.plot(chain).savefig(p)),
    ):
        try:
            write(target)
            written.append(target)
        except ImportError as error:
            missing.append(f"{target.name} not drawn: {error}")
    print("\n".join(missing) + "\n" * bool(missing) + "wrote " + ", ".join(map(str, written)))
    if show:
        webbrowser.open(written[0].resolve().as_uri())
    return 0
