"""The collocation polynomials of an interval, and the chain rule through them.

An interval has unknowns z: its first node, accelerations at all stages, controls, multipliers. A
stage has variables y: position, velocity, acceleration, controls and multipliers at that stage.
Rows are functions of y; the solver needs derivatives by z.

Positions, velocities and accelerations in y are linear in those of z. The coefficients are scalars:
polynomials of the interval's length h. dy/dz is therefore a Kronecker product.
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

# values, indices or mask of an interval's unknowns or a stage's variables, with any leading axes
_Entries = TypeVar("_Entries", np.ndarray, Array)


@dataclasses.dataclass(frozen=True)
class Layout:
    """The order and the numbers of an interval's unknowns and of a stage's variables.

    An interval has the unknowns [t0, T, q, v, a_1 ... a_s, control blocks, f_1 ... f_s]. A stage
    has the variables [t, T, q, v, a, control blocks, f]. t0 and T are the start and the duration of
    the phase, t is the time of the stage, a are accelerations in the chart, f multipliers of links.

    nv: coordinates of the tree. stages: number s of stages. rows: multipliers of a stage.
    control: entries of a control block (see `AbstractControls`).
    blocks: control blocks of an interval. stage_blocks: control blocks of a stage.
    """

    nv: int
    stages: int
    rows: int
    control: int
    blocks: int
    stage_blocks: int

    @property
    def interval_size(self) -> int:
        """Number of unknowns of an interval."""
        motion = (2 + self.stages) * self.nv
        return 2 + motion + self.blocks * self.control + self.stages * self.rows

    @property
    def stage_size(self) -> int:
        """Number of variables of a stage."""
        return 2 + 3 * self.nv + self.stage_blocks * self.control + self.rows

    def split_interval(self, z: _Entries) -> tuple[_Entries, _Entries, _Entries, _Entries]:
        """Return the times [2], motion [2 + s, nv], control blocks and multipliers [s rows]."""
        ends = np.cumsum([2, (2 + self.stages) * self.nv, self.blocks * self.control])
        times, x, w, f = (z[..., a:b] for a, b in zip((0, *ends), (*ends, self.interval_size)))
        shape = z.shape[:-1]
        return (
            times,
            x.reshape(*shape, 2 + self.stages, self.nv),
            w.reshape(*shape, self.blocks, self.control),
            f.reshape(*shape, self.stages, self.rows),
        )

    def split_stage(self, y: _Entries) -> tuple[_Entries, _Entries, _Entries, _Entries]:
        """Return the times [2], motion [3 nv], control blocks and multipliers [rows]."""
        ends = np.cumsum([2, 3 * self.nv, self.stage_blocks * self.control])
        times, x, w, f = (y[..., a:b] for a, b in zip((0, *ends), (*ends, self.stage_size)))
        shape = y.shape[:-1]
        return (
            times,
            x.reshape(*shape, 3, self.nv),
            w.reshape(*shape, self.stage_blocks, self.control),
            f,
        )


class StagePolynomials(eqx.Module):
    """Coefficients of dy/dz of one stage, or of several with a leading axis.

    With h the length of the interval, a stage's motion (q, v, a) is (C0 + h C1 + h^2 C2) times the
    interval's motion (q, v, a_1 ... a_s), and its control blocks are (D0 + h D1) times those of the
    interval.

    c: place of the stage, as a fraction of the interval. b: weight in the quadrature.
    slot: one-hot vector that selects the stage's multipliers among f_1 ... f_s.
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
    """Return the coefficients of stages.

    stages: indices of stages; -1 is the start of the interval. There the accelerations are zero,
    and the multipliers are those of an impulse, which take the place of f_1.
    """
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
    slot = np.eye(s)[[max(i, 0) for i in stages]]
    b = np.array([0.0 if i < 0 else scheme.b[i] for i in stages])
    return StagePolynomials(c=c, b=b, slot=slot, C0=C0, C1=C1, C2=C2, D0=D0, D1=D1)


def _combine(coefficients, blocks):
    """Return the product [k n] of coefficients [k m] and blocks [m n], as a sum over m."""
    return jnp.sum(coefficients[:, :, None] * blocks[None], 1)


class Lift:
    """The map from an interval's unknowns z to one stage's variables y, with its derivatives.

    poly: coefficients of this stage alone. z: unknowns of the interval.
    start_ratio, duration_ratio: start of the interval in its phase, and duration of the phase, both
        divided by the interval's length. In a phase of n equal intervals they are k and n.
    """

    def __init__(
        self,
        layout: Layout,
        poly: StagePolynomials,
        z: Float[Array, " z"],
        start_ratio: Float[Array, ""],
        duration_ratio: Float[Array, ""],
    ):
        self.layout = layout
        self.poly = poly
        self.duration_ratio = duration_ratio
        self.fraction: Float[Array, ""] = (start_ratio + poly.c) / duration_ratio
        (t0, T), x, w, f = layout.split_interval(z)
        self.t0: Float[Array, ""] = t0
        self.T: Float[Array, ""] = T
        self.x: Float[Array, "m nv"] = x
        self.w: Float[Array, "blocks control"] = w
        self.f: Float[Array, "s rows"] = f
        h = T / duration_ratio
        self.C: Float[Array, "3 m"] = poly.C0 + h * poly.C1 + h**2 * poly.C2
        self.D: Float[Array, "d e"] = poly.D0 + h * poly.D1
        # derivatives of C and D by T
        self.dC: Float[Array, "3 m"] = (poly.C1 + 2 * h * poly.C2) / duration_ratio
        self.dD: Float[Array | np.ndarray, "d e"] = poly.D1 / duration_ratio
        self.ddC: Float[Array | np.ndarray, "3 m"] = 2 * poly.C2 / duration_ratio**2

    def variables(self) -> Float[Array, " y"]:
        """Return the stage's variables."""
        t = self.t0 + self.fraction * self.T
        motion, control = _combine(self.C, self.x).ravel(), _combine(self.D, self.w).ravel()
        f = jnp.sum(self.poly.slot[:, None] * self.f, 0)
        return jnp.concatenate([jnp.stack([t, self.T]), motion, control, f])

    def pull_back(self, A: Float[Array, "n y"]) -> Float[Array, "n z"]:
        """Return the matrix product A dy/dz."""
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
        """Return the second derivatives of the function g . y(z) by T and each unknown.

        T is one of each pair, because y is linear in the others. g: gradient of a function by y.
        """
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
        """Return (dy/dz)^T H dy/dz over the unknowns of `dependencies`; `curvature` is the rest.

        H: second derivatives of a function by these variables of the stage.
        """
        columns = dependencies(self.layout, variables)
        some = self.pull_back(jnp.eye(self.layout.stage_size, dtype=H.dtype)[variables])
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
        """Return the entries of the Hessian by the unknowns, in `motion_hessian_pattern`'s order.

        gradient, controls, blocks, by_f: what `StageDerivatives.hessian` returns.
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
            static_take(
                self._motion_pairs(qq, qv, vv, qa).ravel(), _lower_half_of_pairs(self.layout)
            ),
        ]
        return jnp.concatenate([x.ravel() for x in parts])

    def _motion_pairs(self, qq, qv, vv, qa) -> Float[Array, "pairs nv nv"]:
        """Return the second derivatives by pairs n >= m of the interval's q, v, a_1 ... a_s."""
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
    """Return the indices of the interval's unknowns on which these variables of a stage depend."""
    _, x, w, f = layout.split_interval(np.arange(layout.interval_size))
    selected = np.isin(np.arange(layout.stage_size), variables)
    times, motion, control, forces = layout.split_stage(selected)
    start, duration = times[0], times.any() or motion.any() or control.any()
    parts = [x[:, motion.any(0)], w[:, control.any(0)], f[:, forces]]
    rest = np.concatenate([x.ravel() for x in parts])
    return np.concatenate([np.flatnonzero([start, duration]), np.sort(rest)])


def _lower_half_of_pairs(layout: Layout) -> np.ndarray:
    """Return which entries of `Lift._motion_pairs` are in the lower half of the Hessian.

    They are indices into the flat array [pairs nv nv].
    """
    n, m = (x[:, None, None] for x in np.tril_indices(2 + layout.stages))
    i, k = np.indices((layout.nv, layout.nv))
    return np.flatnonzero((n > m) | (i >= k))


def motion_hessian_pattern(layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Return the row and the column of each entry of `Lift.motion_hessian`, as unknowns."""
    at = np.arange(layout.interval_size)
    _, x, w, f = layout.split_interval(at)
    n, m = np.tril_indices(2 + layout.stages)
    motion = np.broadcast_arrays(x[n][:, :, None], x[m][:, None])
    motion = [x.ravel()[_lower_half_of_pairs(layout)] for x in motion]
    first = np.concatenate([[1], x.ravel()])
    of_forces = np.broadcast_arrays(f[..., None], first)
    by_T = np.concatenate([[1], x.ravel(), w.ravel()])
    parts = [(by_T, np.ones_like(by_T)), of_forces, motion]
    row, column = (np.concatenate([np.ravel(part[k]) for part in parts]) for k in (0, 1))
    return row, column
