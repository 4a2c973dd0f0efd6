"""Chains and states of the speed benchmarks, and MuJoCo's models of them.

The cases are the 40-freedom figure on a free base, open and with grips, and the 16-joint figure on
the high bar.
"""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import soft_loops

import svkc
import svkc.scenes

DT = 2e-3  # s
PALM = (0.0, 0.0, -svkc.scenes.PALM)
FIGURE = str(svkc.scenes.FOLDER / "figure40.xml")
CASES = ("open", "two ball grips", "two hinge grips", "high bar")


def figure_with_grips(joint: str):
    """Return the 40-freedom figure with both arms raised forward, each hand connected to the
    ground.

    joint: joint of the two virtual links.
    """
    links = [
        svkc.VirtualLink(
            f"{side}_grip", "world", f"{side}_hand", joint, axis=(0, 1, 0), real_pos=PALM
        )
        for side in ("right", "left")
    ]
    chain = svkc.load(FIGURE, virtual_links=links, ignore=("limit",))
    arm_raised = [np.cos(0.75), 0, -np.sin(0.75), 0]
    pose = {
        f"{side}_{name}": value
        for side in ("right", "left")
        for name, value in (("shoulder", arm_raised), ("elbow", 0.3), ("knee", 0.2))
    }
    return chain, svkc.connect(
        chain, chain.state(pose, connected=()), "right_grip", "left_grip", here=True
    )


def load_case(name: str):
    """Return chain and state of a case."""
    if name == "open":
        chain = svkc.load(FIGURE, ignore=("limit",))
        return chain, chain.state(
            {"right_elbow": 0.3, "left_elbow": 0.3, "right_knee": 0.2, "left_knee": 0.2}
        )
    if name == "high bar":
        return svkc.scenes.high_bar(ignore=("limit",))
    return figure_with_grips("ball" if "ball" in name else "hinge")


def model_path(name: str) -> str:
    """Return the path of the case's MJCF file."""
    return str(svkc.scenes.FOLDER / "figure16.xml") if name == "high bar" else FIGURE


def mujoco_case(name: str, chain, state) -> tuple[mujoco.MjModel, np.ndarray, np.ndarray]:
    """Return MuJoCo's model (step DT, no joint ranges, grips as `connect`), qpos and qvel."""
    spec = mujoco.MjSpec.from_file(model_path(name))
    model = soft_loops.figure_model(SimpleNamespace(chain=chain, state=state), spec, DT)
    model.opt.timestep, model.opt.jacobian = DT, mujoco.mjtJacobian.mjJAC_DENSE
    model.opt.disableflags |= (
        mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    )
    return model, np.asarray(state.q[: chain.nq], float), np.asarray(state.v[: chain.nv], float)


def random_states(chain, state, batch: int):
    """Return a batch of states with random velocities that satisfy the loop constraints."""
    v = jax.random.normal(jax.random.key(0), (batch, chain.dofs), state.v.dtype) * 0.5
    if chain.link_names:
        v = v @ svkc.coordinates(chain, state).W.T
    broadcast = lambda x: jnp.broadcast_to(x, (batch, *x.shape))
    return svkc.State(broadcast(state.q), v, jax.tree.map(broadcast, state.structure))
