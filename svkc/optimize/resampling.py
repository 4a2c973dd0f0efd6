"""Interpolation of motions to another mesh."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from svkc.model.chain import Chain
from svkc.optimize.guesses import Guess, PhaseMotion
from svkc.optimize.points import full_configuration, full_velocity
from svkc.optimize.schemes import Radau
from svkc.optimize.solution import Solution
from svkc.tree.configuration import integrate


def as_guess(guess: Any, problem: Any) -> Guess:
    """Return a guess on the mesh of a problem.

    guess: a `Guess` or a `Solution`, on any mesh.
    Raises ValueError for other types, another number of phases, other controls or another chain.
    """
    if not isinstance(guess, Guess | Solution):
        raise ValueError(
            f"guess: expected problem.guess(...) or a Solution, got {type(guess).__name__}"
        )
    motions = guess.phases if isinstance(guess, Guess) else guess.motion
    if len(motions) != len(problem.phases):
        raise ValueError(f"guess: got {len(motions)} phases, the problem has {len(problem.phases)}")
    names = problem.controls.names(problem.chain)
    state_count = len(names) * int(problem.controls.has_state)
    shapes = {(m.v.shape[1], m.blocks.shape[2], m.states.shape[1]) for m in motions}
    if shapes != {(problem.chain.nv, len(names), state_count)}:
        raise ValueError("guess: it is of another chain, or of other controls, than the problem")
    blocks = problem.controls.blocks(problem.scheme)
    phases = []
    for phase, motion in zip(problem.phases, motions, strict=True):
        same = (phase.intervals, problem.scheme.stages) == motion.vdot.shape[:2]
        same = same and np.allclose(
            motion.times, motion.duration * phase.node_fractions, rtol=0, atol=1e-12
        )
        if not same or motion.blocks.shape[1] != blocks:
            motion = resample(problem.chain, problem.scheme, problem.controls, motion, phase)
        phases.append(motion)
    if isinstance(guess, Guess):
        return Guess(phases, noise=guess.noise, key=guess.key, free=guess.free)
    return Guess(phases, free=problem.args_model.known(guess.args))


def _linear(x: np.ndarray, y: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return y [points ...], given at x, interpolated linearly to the positions `at`."""
    flat = y.reshape(len(y), -1)
    columns = [np.interp(at, x, column) for column in flat.T]
    shape = (len(at), *y.shape[1:])
    return np.stack(columns, 1).reshape(shape) if columns else np.zeros(shape)


def resample(
    chain: Chain, scheme: Radau, controls: Any, motion: PhaseMotion, phase: Any
) -> PhaseMotion:
    """Return the motion of a phase on the mesh of `phase`, with the stages of `scheme`."""
    s, n = motion.vdot.shape[1], phase.intervals
    nodes, new = motion.times / motion.duration, phase.node_fractions
    stages = (new[:-1, None] + np.diff(new)[:, None] * scheme.c).ravel()
    k, share = _within(nodes, stages, "left")
    weights = Radau(s).interpolation(share)
    at_stages = lambda y: np.einsum("ij,ij...->i...", weights, y[k]).reshape(
        n, scheme.stages, *y.shape[2:]
    )
    q, v = _nodes(chain, motion, nodes, new)
    # controls that are constant over an interval: the values in the middle of the new intervals
    has_state, middle = int(controls.has_state), (new[:-1] + new[1:]) / 2
    states = _linear(nodes, motion.states, new)
    free = motion.blocks[:, has_state:]
    if free.shape[1] == s and controls.blocks(scheme) - has_state == scheme.stages:
        blocks = at_stages(free)
    else:
        blocks = np.repeat(
            free[_within(nodes, middle, "left")[0], :1], controls.blocks(scheme) - has_state, 1
        )
    of_states = states[:-1, None] if has_state else blocks[:, :0]
    return PhaseMotion(
        duration=motion.duration,
        q=q,
        v=v,
        states=states,
        blocks=np.concatenate([of_states, blocks], 1),
        vdot=at_stages(motion.vdot),
        forces=at_stages(motion.forces),
        impulse=motion.impulse,
        mesh=new,
    )


def _within(nodes: np.ndarray, at: np.ndarray, side: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the interval of each position, and the position as a fraction of this interval.

    nodes: positions of the nodes. at: positions.
    side: "left": a position on a node is the end of an interval; "right": the start of one.
    """
    k = np.clip(np.searchsorted(nodes, at, side=side) - 1, 0, len(nodes) - 2)
    return k, (at - nodes[k]) / (nodes[k + 1] - nodes[k])


def _nodes(
    chain: Chain, motion: PhaseMotion, nodes: np.ndarray, new: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return q and v of the tree at new nodes, by the collocation polynomials of old intervals.

    nodes, new: positions of the old and of the new nodes, as fractions of the duration.
    """
    k, share = _within(nodes, new, "right")
    s = motion.vdot.shape[1]
    powers, degree = np.arange(s), Radau(s).c[:, None] ** np.arange(s)
    once = (share[:, None] ** (powers + 1) / (powers + 1)) @ np.linalg.inv(degree)
    twice = share[:, None] ** (powers + 2) / ((powers + 1) * (powers + 2)) @ np.linalg.inv(degree)
    h = (motion.duration * np.diff(nodes))[k][:, None]
    change = lambda weights: np.einsum("ij,ijk->ik", weights, motion.vdot[k])
    v = motion.v[k] + h * change(once)
    step = h * share[:, None] * motion.v[k] + h**2 * change(twice)

    def moved(q, step):
        full = full_configuration(chain, q)
        return integrate(chain, full, full_velocity(chain, step))[: chain.nq]

    q = np.array(jax.vmap(moved)(jnp.asarray(motion.q[k]), jnp.asarray(step)))
    q[-1], v[-1] = motion.q[-1], motion.v[-1]
    return q, v
