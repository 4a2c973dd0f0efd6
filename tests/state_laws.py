"""Laws that every result of `chain.state` must satisfy, checked in numpy (`references/`)."""

import numpy as np
from references import rigid_bodies

# 1.1e-9 is eps^(4/7), the largest gap of a closed loop (rad, or in `chain.length`s)
CLOSED = 1.2e-9


def scales(chain):
    """Return the unit of each coordinate: 1 for angles, `chain.length` for lengths."""
    top = chain.topology
    out = np.ones(chain.dofs)
    for kind, d in zip(top.kind, top.v_start, strict=True):
        if kind == rigid_bodies.SLIDE:
            out[d] = chain.length
        elif kind == rigid_bodies.FREE:
            out[d : d + 3] = chain.length
    for dofs in top.links.dof:
        out[[d for d in dofs[3:] if d < chain.dofs]] = chain.length
    return out


def change_weights(chain, connected):
    """Return 1 for the coordinates of the model's own joints, 0 for those that follow from them."""
    top, out = chain.topology, np.zeros(chain.dofs)
    out[: top.nv] = 1
    for _, link, _ in top.cuttable_joints:
        out[[d for d in top.links.dof[link] if d < chain.dofs]] = 1
    for link, row in enumerate(top.link_child):
        if row >= 0 and connected[link]:
            out[top.v_start[row] : top.v_start[row] + 6] = 0
    return out


def outside(J, x):
    """Return the largest entry of the part of x that is not in the range of J^T."""
    basis, s, _ = np.linalg.svd(J.T, full_matrices=False)
    basis = basis[:, s > 1e-7 * s.max(initial=1e-300)]
    return np.abs(x - basis @ (basis.T @ x)).max(initial=0)


def violations(sample, state, *, start, v_before, named_q, named_v, target, v_target, fixed_q):
    """Return a dict of what is wrong with a finite state: {} if it is right.

    start: configuration from which the change is least. v_before: velocities before the projection.
    named_q, named_v: masks of held coordinates; target, v_target: their values.
    fixed_q: whether the named coordinates are held while the change is made least.
    """
    chain, bodies = sample.chain, sample.bodies
    S, q, v = sample.structure(state), np.asarray(state.q)[None], np.asarray(state.v)[None]
    unit, wrong = scales(chain), {}
    gap, J = bodies.loops(S, q)
    row = np.tile([1, 1, 1, *[1 / float(chain.length)] * 3], len(chain.link_names))
    gap, J = gap.ravel() * row, J.reshape(-1, chain.dofs) * row[:, None] * unit
    active = bodies.active(S)[0]
    J = J * active
    wrong["gap"] = np.abs(gap).max(initial=0) / CLOSED
    rate = np.abs(J @ (v[0] / unit)).max(initial=0)
    # held velocities are returned as given if the projected ones deviate by less than CLOSED
    wrong["gap rate"] = rate / (10 * CLOSED * (1 + np.abs(v / unit).max()))
    off = np.abs(bodies.change(q, target[None])[0]) / unit
    wrong["named q"] = np.max(off * named_q, initial=0) / CLOSED
    off_v = np.abs(v[0] - v_target) / unit
    wrong["named v"] = np.max(off_v * named_v, initial=0) / (
        CLOSED * (1 + np.abs(v_target / unit).max())
    )
    wrong["inactive v"] = np.abs(v[0] * ~active).max()
    for at, _ in zip(*chain.topology.quaternion_starts, strict=True):
        wrong["quaternion"] = abs(np.linalg.norm(q[0, at : at + 4]) - 1) / 1e-12
    weight = change_weights(chain, S.connected[0])
    free = active & ~(named_q if fixed_q else np.zeros_like(named_q))
    change = weight * bodies.change(start[None], q)[0] / unit
    size = 1 + np.abs(change).max()
    wrong["least change"] = outside(J[:, free], change[free]) / (1e-6 * size)
    free = active & ~named_v
    change = weight * (v[0] - v_before) / unit
    size = 1 + np.abs(v[0]).max() + np.abs(v_before).max()
    wrong["least change of v"] = outside(J[:, free], change[free]) / (1e-8 * size)
    return {key: value for key, value in wrong.items() if not value <= 1}
