"""Root finding: a bracket about a root of a function, one evaluation per iteration."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from svkc._jax.select import where

# Bisection alone takes 52 iterations in float64, and no function of the tests takes more than 80.
MAX_ITERATIONS = 200


class Bracket(eqx.Module):
    """An interval [a, b] with fa < 0 <= fb that shrinks about a root of a function.

    The root finder is that of Chandrupatla (Advances in Engineering Software 28 (1997), 145-149):
    inverse quadratic interpolation where it is safe, bisection elsewhere. It starts with a secant.

    fa, fb: values at a and b.
    old_end, f_old_end: the end that the last iteration replaced, and the value there.
    moved_b: whether the last iteration replaced b.
    tol: length of a converged bracket.
    count: iterations so far.
    """

    a: Float[Array, ""]
    b: Float[Array, ""]
    fa: Float[Array, ""]
    fb: Float[Array, ""]
    old_end: Float[Array, ""]
    f_old_end: Float[Array, ""]
    moved_b: Bool[Array, ""]
    tol: Float[Array, ""]
    count: Int[Array, ""]

    @staticmethod
    def around(
        a: Float[Array, ""], b: Float[Array, ""], fa: Float[Array, ""], fb: Float[Array, ""]
    ) -> "Bracket":
        """Return the bracket [a, b] before the first iteration. Its tolerance is round-off."""
        eps = jnp.finfo(fb.dtype).eps
        tol = 2 * eps * jnp.maximum(jnp.abs(a), jnp.abs(b)) + eps * (b - a)
        return Bracket(
            a=a,
            b=b,
            fa=fa,
            fb=fb,
            old_end=b,
            f_old_end=fb,
            moved_b=jnp.ones((), bool),
            tol=tol,
            count=jnp.zeros((), jnp.int32),
        )

    def not_converged(self) -> Bool[Array, ""]:
        """Return whether another iteration is needed."""
        return (self.b - self.a > self.tol) & (self.count < MAX_ITERATIONS)

    def next_point(self) -> Float[Array, ""]:
        """Return the point of the next evaluation: the root of an interpolation, or the midpoint.

        It is at least half of the tolerance away from both ends. So where interpolation shows a
        root within round-off of an end, the next point is on the other side of the root.
        """
        # x1 is the last point, x2 the other end of the bracket, x3 the end that x1 replaced
        x1, f1 = where(self.moved_b, self.b, self.a), where(self.moved_b, self.fb, self.fa)
        x2, f2 = where(self.moved_b, self.a, self.b), where(self.moved_b, self.fa, self.fb)
        x3, f3 = self.old_end, self.f_old_end
        xi, phi = _ratio(x1 - x2, x3 - x2), _ratio(f1 - f2, f3 - f2)
        is_safe = (phi**2 < xi) & ((1 - phi) ** 2 < 1 - xi)
        secant = _ratio(f1, f1 - f2)
        quadratic = -secant * _ratio(f3, f2 - f3) + (
            _ratio(x3 - x1, x2 - x1) * _ratio(f1, f3 - f1) * _ratio(f2, f3 - f2)
        )
        fraction = where(self.count == 0, secant, where(is_safe, quadratic, 0.5))
        fraction = where(jnp.isfinite(fraction), fraction, 0.5)  # of infinite values
        c = x1 + fraction * (x2 - x1)
        return jnp.clip(c, self.a + self.tol / 2, self.b - self.tol / 2)

    def update(self, c: Float[Array, ""], fc: Float[Array, ""]) -> "Bracket":
        """Return the bracket shrunk by the value fc of the function at c."""
        right = fc >= 0
        return Bracket(
            a=where(right, self.a, c),
            b=where(right, c, self.b),
            fa=where(right, self.fa, fc),
            fb=where(right, fc, self.fb),
            old_end=where(right, self.b, self.a),
            f_old_end=where(right, self.fb, self.fa),
            moved_b=right,
            tol=self.tol,
            count=self.count + 1,
        )


def _ratio(a: Float[Array, ""], b: Float[Array, ""]) -> Float[Array, ""]:
    """Return a / b, and a where b is zero."""
    return a / where(b == 0, 1, b)
