"""The polynomials of an interval, and derivatives of stages carried through them.

A stage's coordinates, velocities and accelerations are linear in the interval's unknowns with
scalar coefficients that are polynomials of the step h = T / n. Derivatives of a stage's rows are
therefore carried to the unknowns by a few multiplications with scalars (Kronecker products).
"""

import dataclasses
from typing import TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from svkc._jax.static_gather import static_take
from svkc.optimize.controls import AbstractControls
from svkc.optimize.schemes import Radau

# of unknowns or of variables, with leading axes: values, places or masks
_Entries = TypeVar("_Entries", np.ndarray, Array)


@dataclasses.dataclass(frozen=True)
class Layout:
    """Numbers of entries of an interval's unknowns and of a stage's variables.

    An interval has the unknowns [t0, T, q, v, a_1 ... a_s, control blocks, f_1 ... f_s], a stage
    the variables [t, T, q, v, a, control blocks, f].

    nv: coordinates of the tree. stages: s. rows: multipliers of a stage.
    control: numbers in a control block. blocks: control blocks of an interval.
    stage_blocks: control blocks of a stage.
    """

    nv: int
    stages: int
    rows: int
    control: int
    blocks: int
    stage_blocks: int

    @property
    def of_interval(self) -> int:
        """Number of unknowns of an interval."""
        motion = (2 + self.stages) * self.nv
        return 2 + motion + self.blocks * self.control + self.stages * self.rows

    @property
    def of_stage(self) -> int:
        """Number of variables of a stage."""
        return 2 + 3 * self.nv + self.stage_blocks * self.control + self.rows

    def split_interval(self, z: _Entries) -> tuple[_Entries, _Entries, _Entries, _Entries]:
        """Return the unknowns as times [2], motion, control blocks and multipliers."""
        ends = np.cumsum([2, (2 + self.stages) * self.nv, self.blocks * self.control])
        times, x, w, f = (z[..., a:b] for a, b in zip((0, *ends), (*ends, self.of_interval)))
        shape = z.shape[:-1]
        return (
            times,
            x.reshape(*shape, 2 + self.stages, self.nv),
            w.reshape(*shape, self.blocks, self.control),
            f.reshape(*shape, self.stages, self.rows),
        )

    def split_stage(self, y: _Entries) -> tuple[_Entries, _Entries, _Entries, _Entries]:
        """Return the variables of a stage as times [2], motion [3 nv], control blocks and f."""
        ends = np.cumsum([2, 3 * self.nv, self.stage_blocks * self.control])
        times, x, w, f = (y[..., a:b] for a, b in zip((0, *ends), (*ends, self.of_stage)))
        shape = y.shape[:-1]
        return (
            times,
            x.reshape(*shape, 3, self.nv),
            w.reshape(*shape, self.stage_blocks, self.control),
            f,
        )


class StagePolynomials(eqx.Module):
    """Coefficients of one or several stages: y = (C0 + h C1 + h^2 C2) x, w = (D0 + h D1) omega.

    c: fraction of the interval. b: weight in the quadrature.
    slot: one-hot, which of the interval's multipliers are the stage's.
    """

    c: Float[Array | np.ndarray, "..."]
    b: Float[Array | np.ndarray, "..."]
    slot: Float[Array | np.ndarray, "... s"]
    C0: Float[Array | np.ndarray, "... 3 m"]
    C1: Float[Array | np.ndarray, "... 3 m"]
    C2: Float[Array | np.ndarray, "... 3 m"]
    D0: Float[Array | np.ndarray, "... d e"]
    D1: Float[Array | np.ndarray, "... d e"]


def polynomials(scheme: Radau, controls: AbstractControls, stages: list[int]) -> StagePolynomials:
    """Return the coefficients of stages; -1 is the start of the interval, which has no forces."""
    s = scheme.stages
    c = np.array([0.0 if i < 0 else scheme.c[i] for i in stages])
    C0, C1, C2 = np.zeros((3, len(stages), 3, 2 + s))
    C0[:, 0, 0] = C0[:, 1, 1] = 1
    C1[:, 0, 1] = c
    for k, i in enumerate(stages):
        if i >= 0:
            C0[k, 2, 2 + i] = 1
            C1[k, 1, 2:] = scheme.A[i]
            C2[k, 0, 2:] = (scheme.A @ scheme.A)[i]
    D0, D1 = controls.coefficients(scheme, c)
    # the first slot at the start of an interval is that of the impulse
    slot = np.eye(s)[[max(i, 0) for i in stages]]
    b = np.array([0.0 if i < 0 else scheme.b[i] for i in stages])
    return StagePolynomials(c=c, b=b, slot=slot, C0=C0, C1=C1, C2=C2, D0=D0, D1=D1)


def _combine(coefficients, blocks):
    """Return the sums of blocks [m n] with coefficients [k m]: [k n], without a matrix product."""
    return jnp.sum(coefficients[:, :, None] * blocks[None], 1)


class Lift:
    """The map from an interval's unknowns to one stage's variables, with its derivatives.

    layout: numbers of entries. poly: of this stage alone. z: unknowns of the interval.
    index, count: start of the interval and the phase's duration, by the interval's length.
    """

    def __init__(
        self,
        layout: Layout,
        poly: StagePolynomials,
        z: Float[Array, " z"],
        index: Float[Array, ""],
        count: Float[Array, ""],
    ):
        self.layout = layout
        self.poly = poly
        self.count = count
        self.fraction: Float[Array, ""] = (index + poly.c) / count
        (t0, T), x, w, f = layout.split_interval(z)
        self.t0: Float[Array, ""] = t0
        self.T: Float[Array, ""] = T
        self.x: Float[Array, "m nv"] = x
        self.w: Float[Array, "blocks control"] = w
        self.f: Float[Array, "s rows"] = f
        h = T / count
        self.C: Float[Array, "3 m"] = poly.C0 + h * poly.C1 + h**2 * poly.C2
        self.D: Float[Array, "d e"] = poly.D0 + h * poly.D1
        # derivatives by T
        self.dC: Float[Array, "3 m"] = (poly.C1 + 2 * h * poly.C2) / count
        self.dD: Float[Array | np.ndarray, "d e"] = poly.D1 / count
        self.ddC: Float[Array | np.ndarray, "3 m"] = 2 * poly.C2 / count**2

    def variables(self) -> Float[Array, " y"]:
        """Return the stage's variables."""
        t = self.t0 + self.fraction * self.T
        motion, control = _combine(self.C, self.x).ravel(), _combine(self.D, self.w).ravel()
        f = jnp.sum(self.poly.slot[:, None] * self.f, 0)
        return jnp.concatenate([jnp.stack([t, self.T]), motion, control, f])

    def pull_back(self, A: Float[Array, "n y"]) -> Float[Array, "n z"]:
        """Return A dy/dz."""
        n = A.shape[0]
        times, motion, control, f = self.layout.split_stage(A)
        by_T = times[:, 1] + self.fraction * times[:, 0]
        by_T = by_T + jnp.sum(motion * _combine(self.dC, self.x)[None], (1, 2))
        by_T = by_T + jnp.sum(control * _combine(self.dD, self.w)[None], (1, 2))
        through = lambda M, K: jnp.sum(M[:, :, None, :] * K[None, :, :, None], 1).reshape(n, -1)
        return jnp.concatenate(
            [
                jnp.stack([times[:, 0], by_T], 1),
                through(motion, self.C),
                through(control, self.D),
                (f[:, None, :] * self.poly.slot[None, :, None]).reshape(n, -1),
            ],
            1,
        )

    def curvature(self, g: Float[Array, " y"]) -> Float[Array, " z"]:
        """Return the second derivatives by T and each unknown of the stage's variables times g."""
        _, motion, control, _ = self.layout.split_stage(g)
        transposed = lambda K, M: _combine(K.T, M).ravel()
        second = jnp.sum(motion * _combine(self.ddC, self.x))
        parts = [
            jnp.stack([jnp.zeros_like(second), second]),
            transposed(self.dC, motion),
            transposed(self.dD, control),
            jnp.zeros(self.layout.stages * self.layout.rows, g.dtype),
        ]
        return jnp.concatenate(parts)

    def hessian(self, H: Float[Array, "k k"], variables: np.ndarray) -> Float[Array, "m m"]:
        """Return the second derivatives by the unknowns at `dependencies`, without `curvature`.

        H: by some of the stage's variables.
        """
        columns = dependencies(self.layout, variables)
        some = self.pull_back(jnp.eye(self.layout.of_stage, dtype=H.dtype)[variables])
        some = static_take(some.T, columns)
        half = jnp.sum(some[:, :, None] * H[None], 1)
        return jnp.sum(half[:, None] * some[None], 2)

    def motion_hessian(
        self,
        gradient: Float[Array, "3 nv"],
        controls: Float[Array, "stage_blocks control"],
        blocks: Float[Array, "4 nv nv"],
        by_f: Float[Array, "rows nv"],
    ) -> Float[Array, " entries"]:
        """Return the Hessian by the unknowns, at `motion_places`, of a function whose second
        derivatives are those of `StageDerivatives.hessian`.

        gradient, controls, blocks, by_f: as returned there.
        """
        qq, qv, vv, qa = blocks
        d, dd = _combine(self.dC, self.x), _combine(self.ddC, self.x)
        times = lambda M, x: jnp.sum(M * x[None], 1)
        along = jnp.stack(
            [
                times(qq, d[0]) + times(qv, d[1]) + times(qa, d[2]),
                times(qv.T, d[0]) + times(vv, d[1]),
                times(qa.T, d[0]),
            ]
        )
        of_forces = by_f[:, None] * self.C[0][None, :, None]
        of_forces = [jnp.sum(by_f * d[:1], 1)[:, None], of_forces.reshape(len(by_f), self.x.size)]
        parts = [
            jnp.sum(d * along + gradient * dd)[None],
            _combine(self.C.T, along) + _combine(self.dC.T, gradient),
            _combine(self.dD.T, controls),
            self.poly.slot[:, None, None] * jnp.concatenate(of_forces, 1)[None],
            static_take(self._motion_pairs(qq, qv, vv, qa).ravel(), _once(self.layout)),
        ]
        return jnp.concatenate([x.ravel() for x in parts])

    def _motion_pairs(self, qq, qv, vv, qa) -> Float[Array, "pairs nv nv"]:
        """Return the second derivatives by pairs of the interval's vectors."""
        scaled = lambda coefficients, M: coefficients[:, None, None] * M[None]
        n, m = np.tril_indices(len(self.x))
        halves = (
            scaled(self.C[0], qq) + scaled(self.C[1], qv) + scaled(self.C[2], qa),
            scaled(self.C[0], qv.T) + scaled(self.C[1], vv),
            scaled(self.C[0], qa.T),
        )
        left = lambda k: static_take(self.C[k], n)[:, None, None]
        first, second, third = (left(k) * static_take(x, m) for k, x in enumerate(halves))
        return first + second + third


def dependencies(layout: Layout, variables: np.ndarray) -> np.ndarray:
    """Return the unknowns of an interval on which some of a stage's variables depend."""
    _, x, w, f = layout.split_interval(np.arange(layout.of_interval))
    of_stage = np.isin(np.arange(layout.of_stage), variables)
    times, motion, control, forces = layout.split_stage(of_stage)
    start, duration = times[0], times.any() or motion.any() or control.any()
    parts = [x[:, motion.any(0)], w[:, control.any(0)], f[:, forces]]
    rest = np.concatenate([x.ravel() for x in parts])
    return np.concatenate([np.flatnonzero([start, duration]), np.sort(rest)])


def _once(layout: Layout) -> np.ndarray:
    """Return the places, among pairs of vectors, of one of each two symmetric entries."""
    n, m = (x[:, None, None] for x in np.tril_indices(2 + layout.stages))
    i, k = np.indices((layout.nv, layout.nv))
    return np.flatnonzero((n > m) | (i >= k))


def motion_places(layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Return the unknowns (row, column) of the entries of `Lift.motion_hessian`."""
    at = np.arange(layout.of_interval)
    _, x, w, f = layout.split_interval(at)
    n, m = np.tril_indices(2 + layout.stages)
    motion = np.broadcast_arrays(x[n][:, :, None], x[m][:, None])
    motion = [x.ravel()[_once(layout)] for x in motion]
    first = np.concatenate([[1], x.ravel()])
    of_forces = np.broadcast_arrays(f[..., None], first)
    by_T = np.concatenate([[1], x.ravel(), w.ravel()])
    parts = [(by_T, np.ones_like(by_T)), of_forces, motion]
    row, column = (np.concatenate([np.ravel(part[k]) for part in parts]) for k in (0, 1))
    return row, column
