"""F5: what is integrated, one step of it, and how steps are kept on the loops."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from svkc.loops.constraint import active_dofs
from svkc.loops.forward_dynamics import Dynamics, joint_torques, moving, moving_in_lanes
from svkc.loops.projection import dependent_change, inertia_change, settle_by_bodies, settle_loops
from svkc.model.chain import Chain, State, Structure
from svkc.model.validation import function, numbers, one, whole
from svkc.tree.articulated_body import by_bodies
from svkc.tree.inverse_dynamics import limit_forces
from svkc.tree.kinematics import LEVELS_UNROLLED, normalize, rates

# a step that would leave less than this part of itself before a time to be met goes all the way
REST = 1e-6


def frozen(tree):
    """The tree with every array in it held fixed in derivatives."""
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree)


def filled(x, dx):
    """The tangent of x: zeros where dx is None."""
    return jax.tree.map(lambda x, d: jnp.zeros_like(x) if d is None and x is not None else d, x, dx, is_leaf=lambda x: x is None)


def chosen(which, new, old):
    """The new tree where `which`, else the old one."""
    return jax.tree.map(lambda a, b: jnp.where(which, a, b), new, old)


class Motion(eqx.Module):
    """What is integrated: q, v, and the work (J) done by control, limits and dampers; None where the scene has none of them."""

    q: Float[Array, " q"]
    v: Float[Array, " dofs"]
    work: Float[Array, ""] | None = None


class Scene(eqx.Module):
    """The `args` of the vector field: all it depends on besides time and motion. pivots: of the loops' rows, where they are held (`Dynamics.hold`)."""

    chain: Chain
    structure: Structure
    args: Any
    pivots: Float[Array, "steps dofs"] | None = None


class Projection(eqx.Module):
    """Loop drift is taken away after every step by the smallest change of q and v that closes the loops.

    iterations: Newton steps on the position; one leaves a gap of the second order in the drift of a step. change: what is smallest:
    `svkc.inertia_change` (kinetic energy: a velocity that is projected loses energy of second order only), `svkc.least_change` (scaled coordinates)
    or `svkc.dependent_change` (no independent coordinate moves).
    """

    iterations: int = eqx.field(static=True, default=2)
    change: Callable = eqx.field(static=True, default=inertia_change)

    def __check_init__(self):
        whole("iterations", self.iterations, 0)
        function("change", self.change, optional=False)


class Exact(Projection):
    """Dependent coordinates are functions of the independent ones, solved for at every evaluation of the field as well as after every step: what is
    integrated is the paper's theta_G, and the rest follows from it. `iterations` and `change` as in `Projection`."""

    change: Callable = eqx.field(static=True, default=dependent_change)


class Baumgarte(eqx.Module):
    """Loop drift is pulled back while integrating, as by a critically damped spring of this rate (1/s); nothing is projected."""

    rate: Float[Array, ""] | float = 20.0

    def __check_init__(self):
        one("rate", self.rate)


class Drift(eqx.Module):
    """Nothing is done about loop drift."""


class Field(eqx.Module):
    """The vector field of one phase: qdot, vdot, power. differentiated: or in a loop that nothing differentiates, where a `vmap` keeps lanes last."""

    control: Callable | None
    stabilization: Projection | Baumgarte | Drift
    dynamics: Dynamics
    differentiated: bool = eqx.field(static=True, default=True)

    @property
    def pivotless(self) -> bool:
        """Whether steps are put back onto the loops by the loops' forces, without pivots."""
        return self.dynamics.inertia is by_bodies and isinstance(self.stabilization, Projection) and self.stabilization.change is inertia_change

    def __call__(self, t, y: Motion, scene: Scene) -> Motion:
        chain, structure, held = scene.chain, scene.structure, self.stabilization
        if isinstance(held, Exact):
            y, _ = settle(self, scene, y)
        tau, power = self.torques(t, y, scene)
        rate, agree = held.rate if isinstance(held, Baumgarte) else None, isinstance(held, Projection) and not self.pivotless
        if self._in_lanes(chain) and not agree:
            v, vdot = moving_in_lanes(chain, structure, y.q, y.v, tau, rate)
        else:
            v, vdot = moving(chain, structure, y.q, y.v, tau, self.dynamics.inertia, rate, agree, scene.pivots)
        return Motion(rates(chain, y.q, jnp.where(active_dofs(chain, structure), v, 0)), vdot, power)

    def _in_lanes(self, chain: Chain) -> bool:
        """Whether it is for speed alone, and accelerations are had by articulated bodies, level by level."""
        ways = (by_bodies,) if chain.topology.link_names else (by_bodies, None)
        return not self.differentiated and self.dynamics.inertia in ways and len(chain.topology.levels) <= LEVELS_UNROLLED

    def torques(self, t, y: Motion, scene: Scene):
        """Joint torques of the control and the limits, and the power of all that is not conservative (None: there is none)."""
        chain = scene.chain
        tau = jnp.zeros_like(y.v)
        if self.control is not None:
            # traced once for all the places that call it
            asked = eqx.filter_jit(self.control)(t, State(y.q, y.v, scene.structure), scene.args)
            tau = tau + joint_torques(chain, numbers("control", asked, y.v.dtype))
        if chain.limit is not None:
            tau = tau + limit_forces(chain, y.q, y.v)
        if y.work is None:
            return tau, None
        v = jnp.where(active_dofs(chain, scene.structure), y.v, 0)
        return tau, tau @ v if chain.damping is None else tau @ v - jnp.sum(chain.damping * v * v)


def projects(stabilization, scene: Scene) -> bool:
    """Whether steps are put back onto the loops."""
    return bool(scene.chain.topology.link_names) and isinstance(stabilization, Projection)


class Seen(eqx.Module):
    """What the loops show as a step is put back onto them: how far each loop is open yet (rad, `chain.length`s) and, where pivots are chosen,
    |R_mm| / |R_11| and those to go on with."""

    gap: Float[Array, "links 2"]
    margin: Float[Array, ""] | None = None
    pivots: Float[Array, "steps dofs"] | None = None

    @classmethod
    def first(cls, field: Field, scene: Scene, q) -> "Seen | None":
        """Before the first step."""
        if not projects(field.stabilization, scene):
            return None
        links, dofs = len(scene.chain.link_names), scene.chain.dofs
        gap = jnp.zeros((links, 2), q.dtype)
        # the first evaluation of the field finds no pivots held, and chooses
        return cls(gap) if field.pivotless else cls(gap, jnp.ones((), q.dtype), jnp.zeros((min(6 * links, dofs), dofs), q.dtype))

    @property
    def dependent(self) -> Bool[Array, " dofs"]:
        """Coordinates that depend on the others."""
        return jnp.any(self.pivots > 0, 0)


def settle(field: Field, scene: Scene, y: Motion) -> tuple[Motion, Seen | None]:
    """The motion put back: quaternions to unit length, loops closed, velocities in agreement; and what that showed (None: loops are left alone)."""
    chain, structure, held = scene.chain, scene.structure, field.stabilization
    if not projects(held, scene):
        return eqx.tree_at(lambda y: y.q, y, normalize(chain, y.q)), None
    if field.pivotless:
        q, v, *seen = settle_by_bodies(chain, structure, y.q, y.v, held.iterations, field.differentiated)
    else:
        q, v, *seen = settle_loops(chain, structure, y.q, y.v, held.iterations, held.change, scene.pivots, field.dynamics.hold or 0.0)
    return eqx.tree_at(lambda y: (y.q, y.v), y, (q, v)), Seen(*seen)


def finite(y: Motion) -> Bool[Array, ""]:
    """Whether every number is."""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(y)]))


def staged(solver: diffrax.AbstractSolver, kind: str | None) -> diffrax.AbstractSolver:
    """The solver with its loop over stages made for what is to be differentiated: "lax" forwards, "bounded" both ways, None diffrax's own choice."""
    if not isinstance(solver, diffrax.AbstractRungeKutta):
        return solver
    return eqx.tree_at(lambda s: s.scan_kind, solver, kind, is_leaf=lambda x: x is None)


def step_alone(solver: diffrax.AbstractSolver, field: Field, t0, t1, y: Motion, scene: Scene) -> Motion:
    """One settled step of a solver that remembers nothing of the step before, to be differentiated: of each evaluation of the field, and
    of each turn of the loop that settles the step, only the arguments are kept on the way back."""
    rate = eqx.filter_checkpoint(field)
    if isinstance(solver, diffrax.AbstractERK) and isinstance(solver.tableau, diffrax.ButcherTableau):
        raw = _explicit_step(solver.tableau, rate, t0, t1, y, scene)
    else:
        solver = staged(solver, "bounded")
        term = diffrax.ODETerm(rate)
        raw = solver.step(term, t0, t1, y, scene, solver.init(term, t0, t1, y, scene), False)[0]
    return settle(field, scene, raw)[0]


def _explicit_step(tableau: diffrax.ButcherTableau, rate, t0, t1, y: Motion, scene: Scene) -> Motion:
    """An explicit Runge-Kutta step as a loop over its stages, without those that only estimate the error."""
    used = int(np.max(np.flatnonzero(tableau.b_sol))) + 1
    A = np.zeros((used, used))
    for i, row in enumerate(tableau.a_lower[: used - 1]):
        A[i + 1, : i + 1] = row
    c, dtype = np.append(0.0, tableau.c)[:used], t1.dtype
    add = lambda weights, rates: jax.tree.map(lambda y, k: y + (t1 - t0) * jnp.tensordot(weights, k, 1), y, rates)

    def stage(rates, x):
        weights, part, here = x
        k = rate(t0 + part * (t1 - t0), add(weights, rates), scene)
        put = lambda ks, k: jnp.where(here.reshape(-1, *(1,) * k.ndim), k[None], ks)
        return jax.tree.map(put, rates, k), None

    none = jax.tree.map(lambda y: jnp.zeros((used, *y.shape), y.dtype), y)
    stages = (jnp.asarray(A, dtype), jnp.asarray(c, dtype), np.eye(used, dtype=bool))
    rates, _ = jax.lax.scan(stage, none, stages)
    return add(jnp.asarray(tableau.b_sol[:used], dtype), rates)


class FixedSteps(diffrax.AbstractStepSizeController):
    """Steps of dt; diffrax is told the times `ts` to shorten them for. A step that is not finite is not taken: it ends the solve."""

    dt: Float[Array, ""]
    ts: Float[Array, " times"]

    def wrap(self, direction):
        return self

    def _next(self, t):
        times = jnp.where(self.ts > t, self.ts, jnp.inf)
        stop = jnp.min(times, initial=jnp.inf)
        return jnp.where(t + self.dt * (1 + REST) >= stop, stop, t + self.dt)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        return self._next(t0), None

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        whole = finite(y1_candidate)
        said = diffrax.RESULTS.where(whole, diffrax.RESULTS.successful, diffrax.RESULTS.internal_error)
        return whole, jnp.where(whole, t1, t0), self._next(t1), False, controller_state, said


def motion_norm(error: Motion) -> Float[Array, ""]:
    """Root mean square over q and v alone: work and guards do not choose the step."""
    both = jnp.concatenate([error.q, error.v])
    return jnp.sqrt(jnp.mean(both * both))
