"""What a step costs on this machine, beside MuJoCo's on the same model. The whole comparison, with
more peers, is benchmarks/speed.py of the sources."""

import os
import statistics
import time

ONE_KERNEL = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000000"
STEPS, REPEATS, DT = 500, 7, 2e-3


def bench(lanes: int) -> int:
    """Times `svkc.step` in a compiled loop, alone and in a batch on one core, with MuJoCo's mj_step
    taking turns: us a step and lane, median, least, most."""
    # read by XLA when it compiles for the first time: a loop becomes one function
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {ONE_KERNEL}".strip()
    import jax
    from tqdm import tqdm

    jax.config.update("jax_enable_x64", True)
    import mujoco

    import svkc
    from svkc._jax.compilation_cache import use_cache

    use_cache()
    cases = {}
    for name in ("open", "two grips"):
        cases |= {f"{name}: {by}": case for by, case in _cases(name, lanes).items()}
    times: dict[str, list[float]] = {name: [] for name in cases}
    for case, _ in tqdm(cases.values(), desc="compiling", disable=None, leave=False):
        case()
    for _ in tqdm(range(REPEATS), desc="measuring", disable=None, leave=False):
        for name, (case, count) in cases.items():
            begin = time.perf_counter()
            case()
            times[name].append((time.perf_counter() - begin) / STEPS / count * 1e6)
    versions = (
        f"svkc {svkc.__version__}, jax {jax.__version__}, mujoco {mujoco.__version__},"
        f" {os.cpu_count()} cores"
    )
    print(f"the 40-freedom figure on a free base, float64, steps of {DT} s; {versions}")
    print(f"{'us a step and lane':<40}  median   least    most")
    for name, values in times.items():
        print(f"{name:<40}{statistics.median(values):8.2f}{min(values):8.2f}{max(values):8.2f}")
    print("grips are hard in svkc, soft in MuJoCo")
    return 0


def _cases(name: str, lanes: int) -> dict:
    """What is timed, and of how many lanes a call is."""
    import jax
    import jax.numpy as jnp
    import mujoco

    import svkc
    from svkc.scenes import FOLDER, PALM

    spec = mujoco.MjSpec.from_file(str(FOLDER / "figure40.xml"))
    if name != "open":
        for side in ("right", "left"):
            grip = spec.add_equality(
                name=f"{side}_grip",
                type=mujoco.mjtEq.mjEQ_CONNECT,
                objtype=mujoco.mjtObj.mjOBJ_BODY,
            )
            grip.name1, grip.name2, grip.data[:3] = f"{side}_hand", "world", (0, 0, -PALM)
    chain = svkc.load(spec, ignore=("limit",))
    state, model = chain.state(), chain.model.model
    model.opt.timestep = DT
    model.opt.disableflags |= (
        mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    )
    data, tau = mujoco.MjData(model), jnp.zeros(chain.dofs)

    def peer():
        mujoco.mj_resetData(model, data)
        mujoco.mj_step(model, data, STEPS)

    alone = jax.jit(
        lambda s: jax.lax.fori_loop(0, STEPS, lambda _, s: svkc.step(chain, s, tau, DT), s)
    )
    batch, states = (
        jax.jit(jax.vmap(alone)),
        jax.tree.map(lambda x: jnp.repeat(x[None], lanes, 0), state),
    )
    return {
        "mujoco.mj_step, alone": (peer, 1),
        "svkc.step, alone": (lambda: jax.block_until_ready(alone(state)), 1),
        f"svkc.step, {lanes} lanes": (lambda: jax.block_until_ready(batch(states)), lanes),
    }
