"""Controls: torques, torque rates, or the user's own numbers, as unknowns over an interval."""

import abc
import dataclasses
from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Array, Float

from svkc._jax.static_gather import static_take
from svkc.model.annotations import Checked, Function, Integer, Names, Numbers, Scalar
from svkc.model.chain import Chain, State
from svkc.model.checked_jit import torques_over_dofs
from svkc.model.names import unknown_name
from svkc.model.validation import boolean, names, real_array
from svkc.optimize.schemes import Radau

Limits = Checked[Scalar | Numbers | Mapping[str, Any] | None]
Time: TypeAlias = Float[Array, ""]
Blocks: TypeAlias = Float[Array, "k n"]


class AbstractControls(abc.ABC):
    """Base class of controls.

    Controls are stored in control blocks of `count` numbers each, one number for each driven
    coordinate or parameter. An interval has several blocks, such as one for each stage. The blocks
    of a stage are linear in the blocks of its interval, and torques are a function of the blocks of
    a stage.
    """

    # whether the first block is a state: an unknown of the node, continuous within a phase
    has_state: bool = False
    # whether torques depend on time and state; if not, they are linear in the stage's first block
    needs_state: bool = False

    def for_chain(self, chain: Chain) -> "AbstractControls":
        """Return the controls with the defaults that depend on the chain filled in."""
        return self

    @abc.abstractmethod
    def blocks(self, scheme: Radau) -> int:
        """Return the number of blocks of an interval, with the block of the first node's state."""

    @property
    def stage_blocks(self) -> int:
        """Number of blocks of a stage."""
        return 1 + self.has_state

    @abc.abstractmethod
    def coefficients(self, scheme: Radau, fractions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return D0, D1 [times stage_blocks blocks], which give blocks at a time of an interval.

        They are (D0 + h D1) times the blocks of the interval, where h is its length (s).

        fractions: times as fractions of the interval, from 0 to 1.
        """

    @abc.abstractmethod
    def count(self, chain: Chain) -> int:
        """Return how many numbers a block has."""

    @abc.abstractmethod
    def names(self, chain: Chain) -> list[str]:
        """Return the names of a block's numbers."""

    def driven(self, chain: Chain) -> np.ndarray:
        """Return the mask [nv] of the driven coordinates; all False where they are not known."""
        return np.zeros(chain.nv, bool)

    @abc.abstractmethod
    def torques(
        self, chain: Chain, t: Time, state: State | None, blocks: Blocks, args: Any
    ) -> Float[Array, " dofs"]:
        """Return the joint torques (N m, N) at a stage, over every coordinate.

        t: time from the start of the motion (s). blocks: of the stage.
        state: None at stages of the transcription, unless `needs_state`.
        """

    @abc.abstractmethod
    def limits(self, chain: Chain) -> list[np.ndarray]:
        """Return the lower and upper bounds [2 count] of each block of a stage."""


def _bounds(
    name: str, limit: Any, joints: list[str], groups: Mapping[str, list[str]] | None = None
) -> np.ndarray:
    """Return lower and upper bounds [2 n] from a limit in one of the forms of `Torques.limit`.

    name: of the limit, for messages. joints: names of the n numbers that the limit is for.
    groups: names of joints, each with the names of its numbers.

    Raises ValueError, with the nearest names, if a limit is for an unknown name.
    """
    if limit is None:
        return np.full((2, len(joints)), [[-np.inf], [np.inf]])
    if isinstance(limit, Mapping):
        known = dict(groups or {}) | {joint: [joint] for joint in joints}
        bounds = np.full((2, len(joints)), [[-np.inf], [np.inf]])
        # a limit of one coordinate takes precedence over that of its joint
        for key, value in sorted(limit.items(), key=lambda item: item[0] in joints):
            if key not in known:
                raise unknown_name("driven joint", key, tuple(known))
            own = [joints.index(joint) for joint in known[key]]
            bounds[:, own] = _bounds(f"{name}[{key!r}]", value, known[key])
        return bounds
    if isinstance(limit, tuple) and len(limit) == 2:
        pair = [np.broadcast_to(real_array(name, x, float), len(joints)) for x in limit]
        return np.array(pair, float)
    value = np.asarray(real_array(name, limit, float))
    if value.shape not in ((), (len(joints),)):
        raise ValueError(
            f"{name}: got shape {value.shape}, expected one number, or {len(joints)}, one for each"
            f" of {', '.join(joints)}"
        )
    return np.broadcast_to(np.array([-1.0, 1.0])[:, None] * value, (2, len(joints)))


def _driven_joints(chain: Chain, joints: Names | None, *limits: Any) -> list[str]:
    """Return the names of the driven joints.

    They are the joints named. Without names: the keys of all limits. Without these: the actuated
    ones.
    """
    if joints is not None:
        driven_joints = list(names("joints", joints))
    elif named := [limit for limit in limits if isinstance(limit, Mapping)]:
        driven_joints = list(dict.fromkeys(joint for limit in named for joint in limit))
    else:
        driven = np.asarray(chain.actuated)
        driven_joints = [j for j in chain.joint_names if np.all(driven[chain.v_index(j)])]
    for joint in driven_joints:
        at = chain.v_index(joint)
        if at.stop > chain.nv:
            raise ValueError(f"controls: {joint!r} is a virtual link; only joints of the tree are")
    return driven_joints


def _columns(chain: Chain, joints: Any) -> tuple[np.ndarray, list[str]]:
    """Return the indices in v of the joints' coordinates, and the names of the coordinates."""
    at = [i for joint in joints for i in range(chain.nv)[chain.v_index(joint)]]
    return np.array(at, int), [chain.dof_names[i] for i in at]


class _JointTorques(AbstractControls):
    """Controls whose first block holds the torques of the driven joints."""

    joints: Any = None

    def _coordinates(self, chain: Chain) -> tuple[np.ndarray, list[str]]:
        return _columns(chain, self.joints)

    def _bounds(self, chain: Chain, name: str, limit: Any) -> np.ndarray:
        groups = {joint: _columns(chain, [joint])[1] for joint in self.joints}
        return _bounds(name, limit, self.names(chain), groups)

    def driven(self, chain: Chain) -> np.ndarray:
        return np.isin(np.arange(chain.nv), self._coordinates(chain)[0])

    def count(self, chain: Chain) -> int:
        return len(self._coordinates(chain)[0])

    def names(self, chain: Chain) -> list[str]:
        return self._coordinates(chain)[1]

    def torques(
        self, chain: Chain, t: Time, state: State | None, blocks: Blocks, args: Any
    ) -> Float[Array, " dofs"]:
        at = self._coordinates(chain)[0]
        place = np.full(chain.dofs, len(at))
        place[at] = np.arange(len(at))
        return static_take(blocks[0], place)


@dataclasses.dataclass(frozen=True)
class Torques(_JointTorques):
    """Joint torques as controls.

    Over an interval a torque is the polynomial through one value at each stage, or constant.

    limit: largest torque of each joint (N m, N): a number, an array over the driven coordinates, a
        pair (lower, upper), or these by joint name. None: no limit.
    joints: names of the driven joints; None: those named in `limit`, or all actuated ones.
    constant: whether a torque is constant over an interval.
    """

    limit: Limits = None
    joints: Names | None = None
    constant: bool = False

    def for_chain(self, chain: Chain) -> "Torques":
        joints = _driven_joints(chain, self.joints, self.limit)
        return dataclasses.replace(self, joints=tuple(joints))

    def blocks(self, scheme: Radau) -> int:
        return 1 if boolean("constant", self.constant) else scheme.stages

    def coefficients(self, scheme: Radau, fractions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        constant = np.ones((len(fractions), 1))
        D0 = (constant if self.constant else scheme.interpolation(fractions))[:, None]
        return D0, np.zeros_like(D0)

    def limits(self, chain: Chain) -> list[np.ndarray]:
        return [self._bounds(chain, "limit", self.limit)]


@dataclasses.dataclass(frozen=True)
class TorqueRates(_JointTorques):
    """Torque rates as controls. They are constant over an interval; torques are states.

    limit: largest rate of each joint's torque (N m/s, N/s), in the forms of `Torques.limit`.
    torque: largest torque of each joint (N m, N), in the same forms.
    joints: names of the driven joints; None: those named in a limit, or all actuated ones.
    """

    limit: Limits = None
    torque: Limits = None
    joints: Names | None = None
    has_state = True

    def for_chain(self, chain: Chain) -> "TorqueRates":
        joints = _driven_joints(chain, self.joints, self.torque, self.limit)
        return dataclasses.replace(self, joints=tuple(joints))

    def blocks(self, scheme: Radau) -> int:
        return 2

    def coefficients(self, scheme: Radau, fractions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        D0, D1 = np.zeros((2, len(fractions), 2, 2))
        D0[:, 0, 0] = D0[:, 1, 1] = 1
        D1[:, 0, 1] = fractions
        return D0, D1

    def limits(self, chain: Chain) -> list[np.ndarray]:
        limits = {"torque": self.torque, "limit": self.limit}
        return [self._bounds(chain, name, limit) for name, limit in limits.items()]


@dataclasses.dataclass(frozen=True)
class Parametrized(AbstractControls):
    """Joint torques as a function of the user's own numbers u, which are unknowns at each stage.

    size: how many numbers u has.
    function: (t, state, u, args) -> joint torques (N m, N), as `control` of `svkc.simulate` returns
        them.
    limit: largest magnitude of each number, in the forms of `Torques.limit`; names are u[0], u[1],
        ...
    """

    size: Integer
    function: Function
    limit: Limits = None
    needs_state = True

    def blocks(self, scheme: Radau) -> int:
        return scheme.stages

    def coefficients(self, scheme: Radau, fractions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        D0 = scheme.interpolation(fractions)[:, None]
        return D0, np.zeros_like(D0)

    def count(self, chain: Chain) -> int:
        return int(self.size)

    def names(self, chain: Chain) -> list[str]:
        return [f"u[{i}]" for i in range(int(self.size))]

    def torques(
        self, chain: Chain, t: Time, state: State | None, blocks: Blocks, args: Any
    ) -> Float[Array, " dofs"]:
        return torques_over_dofs(chain, self.function(t, state, blocks[0], args))

    def limits(self, chain: Chain) -> list[np.ndarray]:
        return [_bounds("limit", self.limit, self.names(chain))]
