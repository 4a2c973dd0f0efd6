"""Calls of `svkc.optimize` that raise, by the message that each raises."""

import functools
import json

import jax.numpy as jnp
import numpy as np

import svkc
from svkc import optimize
from svkc.optimize.archive import SCHEMA
from svkc.optimize.block_chain import LARGEST_DENSE, BlockChain

CART = (
    '<mujoco><worldbody><body name="cart"><joint name="x" type="slide" axis="1 0 0"/><geom'
    ' type="sphere" size="0.1" mass="1"/></body></worldbody></mujoco>'
)
PIN = svkc.VirtualLink("pin", "world", "cart", "ball")


@functools.cache
def cart(**options) -> svkc.Chain:
    return svkc.load(CART, virtual_links=[PIN], **options)


@functools.cache
def ball() -> svkc.Chain:
    """Return a body on a ball joint."""
    return svkc.load(CART.replace('name="x" type="slide" axis="1 0 0"', 'name="turn" type="ball"'))


def phase(**changed):
    return optimize.Phase(**({"name": "move", "intervals": 1} | changed))


def problem(controls=None, chain=None, scheme=None, **of_phase):
    """Return a problem of one phase."""
    controls = optimize.Torques(1.0, constant=True) if controls is None else controls
    return optimize.Problem(
        chain or cart(), [phase(**of_phase)], controls=controls, scheme=optimize.Radau(1)
    )


def check(first=0.0, last=1.0, of=None, **of_phase):
    """Check a problem at a straight line."""
    of = problem(**of_phase) if of is None else of
    return of.check(of.guess([{"x": first}, {"x": last}]))


@functools.cache
def fixed_problem():
    """Return a problem with a row of fixed unknowns, and a square root at the end."""
    return problem(
        start=[optimize.between("x", 0, 0), lambda p: (p.state.q[0] - 1, 0, 0)],
        end=[lambda p: jnp.sqrt(p.state.q[0])],
    )


def too_few_iterations(_):
    """Solve a problem with one iteration."""
    rest = optimize.between("x", 0, 0, of="velocity")
    ends = {"start": [optimize.between("x", 0, 0), rest], "end": [optimize.between("x", 1, 1)]}
    move = problem(**ends)
    solver = optimize.Ipopt(max_iterations=1, backend="cyipopt")
    move.solve(move.guess([{"x": 0.0}, {"x": 1.0}]), solver=solver)


def not_a_chain(_):
    """Couple the first interval of a large matrix with the last one."""
    group = np.arange(LARGEST_DENSE + 1)
    BlockChain(group, group, group[::-1])


def load(**meta):
    """Return a call that loads a file of metadata alone."""

    def call(s):
        path = s.folder / "solution.npz"
        np.savez(path, metadata=np.array(json.dumps(meta)))
        return optimize.load_solution(path, problem())

    return call


def on_point(call, where="end"):
    """Return a call that checks a problem with a constraint."""
    return lambda s: check(**{where: [call]})


def with_args(**options):
    """Return a problem with the arg "mass"."""
    controls = optimize.Torques(1.0, constant=True)
    return optimize.Problem(cart(), [phase()], controls=controls, args={"mass": 1.0}, **options)


CASES = {
    "... depends on fixed": lambda s: check(of=fixed_problem()),
    "... has schema ... of solutions": load(optimize_schema=99),
    "... is not a complete file of a solution: ...": load(),
    "... is not a complete file of a solution: ... is missing": load(
        optimize_schema=SCHEMA, result="successful", problem={}
    ),
    "... is of another problem": load(optimize_schema=SCHEMA, problem={"stages": 7}),
    "...: a point at the start": on_point(lambda p: p.vdot[0], "start"),
    "...: expected a cost": lambda s: check(running=lambda p: p.u),
    "...: got ..., expected a function of a point": on_point(3),
    "...: got shape ..., expected one number, or": lambda s: check(
        controls=optimize.Torques(np.ones(3))
    ),
    "...: the virtual link": on_point(lambda p: p.forces("pin")[2]),
    "InteriorPoint: rows couple": not_a_chain,
    "Radau: got": lambda s: optimize.Radau(9),
    "at the guess ... is": lambda s: check(last=-1.0, of=fixed_problem()),
    "at the guess the derivative": lambda s: check(last=0.0, of=fixed_problem()),
    "backend: got": lambda s: optimize.Ipopt(backend="snopt"),
    "between: ... has": lambda s: optimize.between("x", 1, 0),
    "between: got bounds": lambda s: check(bounds=[optimize.between("x", [0, 1], [1, 2])]),
    "between: of=": lambda s: check(bounds=[optimize.between("x", 0, 1, of="torque")]),
    "chain_from: expected": lambda s: with_args(chain_from=lambda chain, args: s.four),
    "chain: virtual link": lambda s: problem(
        optimize.Torques(),
        svkc.load(CART.replace('type="slide"', 'type="slide" stiffness="2"'), cuttable="x"),
    ),
    "constraint ...: expected numbers": on_point(lambda p: None),
    "constraint ...: got the bounds": on_point((lambda p: p.state.q[0], 1, 0)),
    "constraint ...: its bounds": on_point(lambda p: (p.state.q[0], p.state.v[0], 1)),
    "controls: ... is": lambda s: problem(optimize.Torques(joints=["pin"])),
    "free: the value": lambda s: with_args(free={"mass": (2, 3)}),
    "free[...]: expected": lambda s: with_args(free={"mass": (2, 1)}),
    "free[...]: got shape": lambda s: with_args(free={"mass": (1, 2)}).guess(
        [{}, {}], free={"mass": np.ones(2)}
    ),
    "guess: expected problem.guess": lambda s: problem().solve(3),
    "guess: got durations": lambda s: problem().guess([{}, {}], [1.0, 2.0]),
    "guess: got the durations": lambda s: problem().guess([{}, {}], [0.0]),
    "guess: got ... phases": lambda s: optimize.Problem(
        cart(), [phase(), phase(name="other")], controls=optimize.Torques()
    ).solve(problem().guess([{}, {}])),
    "guess: got ... poses": lambda s: problem().guess([{}]),
    "guess: it is of": lambda s: problem(optimize.Torques()).solve(
        problem(optimize.Torques(), ball()).guess([{}, {}])
    ),
    "guess: the first": lambda s: problem().guess([None, {}]),
    "impulse: a point": on_point(lambda p: p.impulse("pin")[2]),
    "of: got": lambda s: optimize.between("x", 0, 1, of="color"),
    "phase ...: ... is a spare slot": lambda s: check(chain=cart(spare=1), connected=("spare_0",)),
    "phase ...: ... must be a list": lambda s: phase(path=3),
    "phase ...: between": lambda s: problem(
        optimize.Torques(), ball(), bounds=[optimize.between("turn.ry", -1, 1)]
    ).solve(problem(optimize.Torques(), ball()).guess([{}, {}])),
    "phase ...: ... has a between": lambda s: phase(
        end=[optimize.between("x", 0, 1, of="control")]
    ),
    "phase ...: bounds has": lambda s: phase(bounds=[lambda p: p.t]),
    "phase ...: got ... intervals": lambda s: phase(intervals=0),
    "phase ...: got the duration": lambda s: phase(duration=(2, 1)),
    "phase ...: got the mesh": lambda s: phase(mesh=[0, 0.5]),
    "phase ...: here names": lambda s: phase(here="pin"),
    "phase ...: path has": lambda s: phase(path=[optimize.between("x", 0, 1)]),
    "phase ...: the bounds of": lambda s: check(
        bounds=[optimize.between("x", 0, 1)], start=[optimize.between("x", 2, 3)]
    ),
    "phase: name": lambda s: phase(name=3),
    "phases: expected": lambda s: optimize.Problem(cart(), [], controls=optimize.Torques()),
    "solve: ...": too_few_iterations,
    "with_mesh: got": lambda s: problem().with_mesh([2, 2]),
}

ALSO = [
    ("torques: the virtual link", on_point(lambda p: p.torques("pin")[2])),
    ("impulse: the virtual link", on_point(lambda p: p.impulse("pin")[2], "start")),
]
