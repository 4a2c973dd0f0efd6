"""How the bodies are joined (`Structure`, for one phase) and how they move (`State`, at one
instant)."""

import equinox as eqx
from jaxtyping import Array, Bool, Float, Int


class Structure(eqx.Module):
    """How the bodies are joined during one phase: one entry for each virtual link.

    Every field may have leading batch axes.

    connected: whether the virtual link is connected.
    parent: row of `Topology` of the parent body.
    real: row of `Topology` of the real link.
    pos: origin of the joint's frame in the parent's frame (m).
    quat: orientation of the joint's frame in the parent's frame (wxyz); the joint's axis is z.
    real_pos: origin of the joint's frame in the real link's frame (m).
    real_quat: orientation of the joint's frame in the real link's frame (wxyz).
    freedoms: freedoms of the virtual joint: rotations about x, y, z, then translations along them.
    rank: the rank m of the loop constraints, computed once for the phase.
    margin: |R_mm| / |R_11| of the pivoted QR factorisation that gave the rank.
    locked: joint coordinates that are locked; None if no joint can be locked.
    independent: joint coordinates preferred as independent ones; None: no preference.
    """

    connected: Bool[Array, "... links"]
    parent: Int[Array, "... links"]
    real: Int[Array, "... links"]
    pos: Float[Array, "... links 3"]
    quat: Float[Array, "... links 4"]
    real_pos: Float[Array, "... links 3"]
    real_quat: Float[Array, "... links 4"]
    freedoms: Bool[Array, "... links 6"]
    rank: Int[Array, "..."]
    margin: Float[Array, "..."]
    locked: Bool[Array, "... dofs"] | None = None
    independent: Bool[Array, "... dofs"] | None = None


class State(eqx.Module):
    """Positions and velocities at one instant, and the structure that holds there.

    Every field may have leading batch axes.

    q: the tree's coordinates (m, rad, wxyz; qpos if none is cuttable), then the virtual joints'.
    v: the tree's velocities (m/s, rad/s; qvel if none is cuttable), then the virtual joints'.
    structure: how the bodies are joined.
    """

    q: Float[Array, "... q"]
    v: Float[Array, "... dofs"]
    structure: Structure
