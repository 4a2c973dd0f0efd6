"""Args of a problem that the solver chooses, such as a limb's length or the height of a bar."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from svkc.model.chain import Chain
from svkc.model.checked_jit import check_chain
from svkc.model.names import unknown_name
from svkc.optimize.blocks import Block, Multipliers, Unknowns, lower_half
from svkc.optimize.equations import Params


class ArgsModel:
    """How the chain depends on the args, and which args are unknowns.

    chain: the chain that the user gave. chain_from: function (chain, args) -> chain; None: the
        chain does not depend on the args.
    names: names of the free args. shapes: their shapes. lower, upper: bounds of all their numbers.

    Raises ValueError for wrong names or bounds, and if `chain_from` returns no chain with the same
    bodies, joints and links.
    """

    def __init__(
        self,
        chain: Chain,
        args: Any,
        free: Mapping[str, Any],
        chain_from: Callable[[Chain, Any], Chain] | None,
    ):
        self.chain = chain
        self.chain_from = chain_from
        self.names: tuple[str, ...] = tuple(free)
        known = tuple(args) if isinstance(args, dict) else ()
        for name in free:
            if name not in known:
                raise unknown_name("free arg", name, known)
        values = {name: np.asarray(args[name], float) for name in free}
        self.shapes: dict[str, tuple[int, ...]] = {name: x.shape for name, x in values.items()}
        pairs = [self._bounds(name, free[name]) for name in free]
        self.lower, self.upper = (np.concatenate([np.zeros(0), *x]) for x in zip(*pairs, ((), ())))
        self.numbers(args)
        resolved = self.resolve(Params(chain, args)).chain
        check_chain(resolved)
        if resolved.topology != chain.topology:
            raise ValueError("chain_from: expected a chain with the same bodies, joints and links")

    def _bounds(self, name: str, bounds: Any) -> list[np.ndarray]:
        """Return the bounds of a free arg. Raises ValueError if they are not finite or crossed."""
        try:
            low, high = (
                np.broadcast_to(np.asarray(x, float), self.shapes[name]).ravel() for x in bounds
            )
        except (TypeError, ValueError):
            low = high = np.array([np.nan])
        if not np.all(np.isfinite(low) & np.isfinite(high) & (low < high)):
            raise ValueError(
                f"free[{name!r}]: expected (lower, upper), finite, with lower < upper, got"
                f" {bounds!r}"
            )
        return [low, high]

    def __bool__(self) -> bool:
        return bool(self.names) or self.chain_from is not None

    def numbers(self, args: Any, others: Mapping[str, Any] | None = None) -> np.ndarray:
        """Return the numbers of the free args.

        others: values by name that replace those in args.
        Raises ValueError for unknown names, other shapes, and values that are not in their bounds.
        """
        values = {name: args[name] for name in self.names}
        for name, value in (others or {}).items():
            if name not in values:
                raise unknown_name("free arg", name, self.names)
            if np.shape(value) != self.shapes[name]:
                raise ValueError(
                    f"free[{name!r}]: got shape {np.shape(value)}, expected {self.shapes[name]}"
                )
            values[name] = value
        parts = [np.ravel(np.asarray(x, float)) for x in values.values()]
        numbers = np.concatenate([np.zeros(0), *parts])
        if np.any(wrong := (numbers < self.lower) | (numbers > self.upper)):
            k = int(np.argmax(wrong))
            raise ValueError(
                f"free: the value {numbers[k]:g} of {self.labels[k]} is not between its bounds"
                f" {self.lower[k]:g} and {self.upper[k]:g}"
            )
        return numbers

    def known(self, args: Any) -> dict[str, Any]:
        """Return those of args that are free args with these shapes, by name."""
        if not isinstance(args, dict):
            return {}
        return {
            name: args[name]
            for name in self.names
            if name in args and np.shape(args[name]) == self.shapes[name]
        }

    @property
    def labels(self) -> list[str]:
        """Name of each number of the free args."""
        return [
            name if shape == () else f"{name}[{k}]"
            for name, shape in self.shapes.items()
            for k in range(int(np.prod(shape)))
        ]

    def with_numbers(self, args: Any, numbers: Any) -> Any:
        """Return args with other numbers of the free args. numbers: None: args unchanged."""
        if not self.names or numbers is None:
            return args
        counts = [int(np.prod(self.shapes[name])) for name in self.names]
        parts = jnp.split(jnp.asarray(numbers), np.cumsum(counts)[:-1])
        return dict(args) | {
            name: x.reshape(self.shapes[name]) for name, x in zip(self.names, parts, strict=True)
        }

    def resolve(self, params: Params, numbers: Any = None) -> Params:
        """Return the chain and the args for some numbers of the free args.

        params: the chain that the user gave, and the args.
        """
        args = self.with_numbers(params.args, numbers)
        chain = params.chain if self.chain_from is None else self.chain_from(params.chain, args)
        return Params(chain, args)


class ArgsBlock(Block):
    """A row block whose functions depend on the free args, too.

    The numbers of the free args are the last local unknowns of every lane. Derivatives by them are
    those of automatic differentiation through the block's rows and Jacobian.

    block: the block for known args. free: indices of the free args' unknowns.
    """

    def __init__(self, block: Block, model: ArgsModel, free: np.ndarray):
        self.block = block
        self.model = model
        self.rows = block.rows
        self.data = block.data
        of_lanes = np.broadcast_to(free, (len(block.unknowns), len(free)))
        self.unknowns = np.concatenate([block.unknowns, of_lanes], 1)
        if block.masks is not None:
            of_rows = np.tile(block.by_args, (self.rows.shape[1] // len(block.by_args), 1))
            of_pairs = np.full(self._hessian_part[0].size, of_rows.any())
            parts = of_rows.ravel(), of_pairs
            self.masks = (np.append(block.masks[0], parts[0]), np.append(block.masks[1], parts[1]))

    def set_lanes(self, lanes: Any) -> None:
        self.block.set_lanes(lanes)
        self.data = self.block.data

    def _split(self, params: Any, z: Unknowns) -> tuple[Callable, jax.Array, jax.Array]:
        """Return the function numbers -> params, the numbers, and the unknowns of the block."""
        n = self.block.unknowns.shape[1]
        return lambda x: self.model.resolve(params, x), z[0, n:], z[:, :n]

    def values(self, params: Any, data: Any, z: Unknowns) -> jax.Array:
        at, x, z = self._split(params, z)
        return self.block.values(at(x), data, z)

    def jacobian(self, params: Any, data: Any, z: Unknowns) -> jax.Array:
        at, x, z = self._split(params, z)
        own = self.block.jacobian(at(x), data, z)
        by_args = jax.jacfwd(lambda x: self.block.values(at(x), data, z))(x)
        return jnp.concatenate([own, by_args.reshape(len(z), -1)], 1)

    def hessian(self, params: Any, data: Any, z: Unknowns, multipliers: Multipliers) -> jax.Array:
        at, x, z = self._split(params, z)
        row, column = self.block.jacobian_pattern

        def gradient(x):
            """Return the derivatives by z of multipliers . rows."""
            entries = self.block.jacobian(at(x), data, z) * multipliers[:, row]
            return jnp.zeros_like(z).at[:, column].add(entries)

        total = lambda x: jnp.sum(self.block.values(at(x), data, z) * multipliers, 1)
        mixed, of_args = jax.jacfwd(gradient)(x), jax.jacfwd(jax.jacfwd(total))(x)
        parts = (
            self.block.hessian(at(x), data, z, multipliers),
            jnp.swapaxes(mixed, 1, 2).reshape(len(z), -1),
            jax.vmap(lower_half)(of_args),
        )
        return jnp.concatenate(parts, 1)

    @property
    def _jacobian_part(self) -> tuple[np.ndarray, np.ndarray]:
        """Local row and local unknown of the entries by the free args."""
        n, size = self.block.unknowns.shape[1], self.unknowns.shape[1]
        row, column = np.indices((self.rows.shape[1], size - n))
        return row.ravel(), n + column.ravel()

    @property
    def _hessian_part(self) -> tuple[np.ndarray, np.ndarray]:
        """The two local unknowns of the entries by a free arg and by any unknown."""
        n, size = self.block.unknowns.shape[1], self.unknowns.shape[1]
        row, column = np.indices((size - n, n))
        both = np.tril_indices(size - n)
        return np.append(n + row.ravel(), n + both[0]), np.append(column.ravel(), n + both[1])

    @property
    def jacobian_pattern(self) -> tuple[np.ndarray, np.ndarray]:
        own = self.block.jacobian_pattern
        return tuple(np.append(a, b) for a, b in zip(own, self._jacobian_part))  # pyright: ignore

    @property
    def hessian_pattern(self) -> tuple[np.ndarray, np.ndarray]:
        own = self.block.hessian_pattern
        return tuple(np.append(a, b) for a, b in zip(own, self._hessian_part))  # pyright: ignore
