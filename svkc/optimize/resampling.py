"""Motions on another mesh."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from svkc.model.chain import Chain
from svkc.optimize.guesses import Guess, PhaseMotion
from svkc.optimize.points import tree_configuration, tree_velocity
from svkc.optimize.schemes import Radau
from svkc.optimize.solution import Solution
from svkc.tree.configuration import difference, integrate


def as_guess(guess: Any, problem: Any) -> Guess:
    """Return a guess on the mesh of a problem, from a guess or from a solution on any mesh.

    Raises ValueError for anything else, and for other phases.
    """
    if not isinstance(guess, Guess | Solution):
        raise ValueError(
            f"guess: expected problem.guess(...) or a Solution, got {type(guess).__name__}"
        )
    motions = guess.phases if isinstance(guess, Guess) else guess.motion
    if len(motions) != len(problem.phases):
        raise ValueError(f"guess: got {len(motions)} phases, the problem has {len(problem.phases)}")
    blocks = problem.controls.blocks(problem.scheme)
    phases = []
    for phase, motion in zip(problem.phases, motions, strict=True):
        same = (phase.intervals, problem.scheme.stages) == motion.vdot.shape[:2]
        if not same or motion.blocks.shape[1] != blocks:
            motion = resample(problem.chain, problem.scheme, problem.controls, motion, phase)
        phases.append(motion)
    if isinstance(guess, Guess):
        return Guess(phases, guess.noise, guess.key)
    return Guess(phases)


def _linear(x: np.ndarray, y: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return y [points ...] at x interpolated linearly, along the first axis."""
    flat = y.reshape(len(y), -1)
    columns = [np.interp(at, x, column) for column in flat.T]
    shape = (len(at), *y.shape[1:])
    return np.stack(columns, 1).reshape(shape) if columns else np.zeros(shape)


def resample(
    chain: Chain, scheme: Radau, controls: Any, motion: PhaseMotion, phase: Any
) -> PhaseMotion:
    """Return a phase of a motion with another number of intervals or stages."""
    old, s, n = len(motion.vdot), motion.vdot.shape[1], phase.intervals
    nodes, new = np.linspace(0, 1, old + 1), np.linspace(0, 1, n + 1)
    of_old = ((np.arange(old)[:, None] + Radau(s).c) / old).ravel()
    of_new = ((np.arange(n)[:, None] + scheme.c) / n).ravel()
    at_stages = lambda y: _linear(of_old, y.reshape(old * s, *y.shape[2:]), of_new).reshape(
        n, scheme.stages, *y.shape[2:]
    )
    # of controls: the values in the middle of the new intervals
    has_state, middle = int(controls.has_state), (np.arange(n) + 0.5) / n
    centers = (np.arange(old) + 0.5) / old
    states = _linear(nodes, motion.states, new)
    free = motion.blocks[:, has_state:]
    if free.shape[1] == s and controls.blocks(scheme) - has_state == scheme.stages:
        blocks = at_stages(free)
    else:
        nearest = np.abs(middle[:, None] - centers).argmin(1)
        blocks = np.repeat(free[nearest, :1], controls.blocks(scheme) - has_state, 1)
    of_states = states[:-1, None] if has_state else blocks[:, :0]
    return PhaseMotion(
        duration=motion.duration,
        q=_configurations(chain, motion.q, nodes, new),
        v=_linear(nodes, motion.v, new),
        states=states,
        blocks=np.concatenate([of_states, blocks], 1),
        vdot=at_stages(motion.vdot),
        forces=at_stages(motion.forces),
        impulse=motion.impulse,
    )


def _configurations(chain: Chain, q: np.ndarray, nodes: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Return configurations of the tree at new nodes, along straight lines between old ones."""
    left = np.clip(np.searchsorted(nodes, new, side="right") - 1, 0, len(nodes) - 2)
    share = (new - nodes[left]) / (nodes[left + 1] - nodes[left])

    def between(start, end, share):
        start, end = tree_configuration(chain, start), tree_configuration(chain, end)
        step = tree_velocity(chain, difference(chain, start, end)[: chain.nv])
        return integrate(chain, start, share * step)[: chain.nq]

    arrays = (jnp.asarray(x) for x in (q[left], q[left + 1], share))
    return np.asarray(jax.vmap(between)(*arrays))
