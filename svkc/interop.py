"""F2: states as MuJoCo holds them, and quaternions as those do who put the scalar last."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc.chain import Chain, State


def _equalities(chain: Chain) -> list[tuple[int, int]]:
    """(virtual link, MuJoCo's <equality>) of each link that was one."""
    model, names = chain.model.model, {name: i for i, name in enumerate(chain.link_names)}
    return [(names[model.equality(i).name], i) for i in range(model.neq) if model.equality(i).name in names]


def _checked(chain: Chain, data) -> None:
    nq, nv = len(chain.topology.model_q), len(chain.topology.model_v)
    if data.qpos.shape != (nq,) or data.qvel.shape != (nv,):
        raise ValueError(f"data: got {data.qpos.shape[0]} qpos and {data.qvel.shape[0]} qvel, the chain's model has {nq} and {nv}; make it of the same model")


def to_mujoco(chain: Chain, state: State, data) -> None:
    """Copies q (m, rad, wxyz) and v (m/s, rad/s) into a `mujoco.MjData` of the chain's model, and which of its <equality> hold; call `mj_forward` next.

    Of a joint that was cut, the coordinates that it would have. ValueError: the data is another model's.
    """
    _checked(chain, data)
    data.qpos[:] = np.asarray(state.q)[np.array(chain.topology.model_q, int)]
    data.qvel[:] = np.asarray(state.v)[np.array(chain.topology.model_v, int)]
    for link, equality in _equalities(chain):
        data.eq_active[equality] = bool(state.structure.connected[link])


def from_mujoco(chain: Chain, data) -> State:
    """The state in a `mujoco.MjData` of the chain's model, by copy: its loops are closed and velocities made consistent, as by `chain.state`; links that
    were <equality> hold where it says so, others as in the chain. ValueError: the data is another model's, a loop cannot be closed."""
    _checked(chain, data)
    connected = np.array(chain.structure.connected)
    for link, equality in _equalities(chain):
        connected[link] = bool(data.eq_active[equality])
    return chain.state(np.array(data.qpos), np.array(data.qvel), connected)


def xyzw(chain: Chain, q: Float[Array, " q"]) -> Float[Array, " q"]:
    """Q with the scalar of every quaternion last, as Pinocchio, ROS and scipy have it."""
    starts, _ = chain.topology.quaternions
    if not len(starts):
        return q
    at = starts[:, None] + np.arange(4)
    return q.at[at].set(jnp.roll(q[at], -1, axis=-1))
