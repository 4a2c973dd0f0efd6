"""`Problem`: phases, controls and costs, with the calls that check and solve it."""

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from svkc.model.annotations import Checked, Function, Integer
from svkc.model.chain import Chain
from svkc.model.checked_jit import check_chain
from svkc.model.validation import boolean, check_function, integer
from svkc.optimize.checks import Check, check, check_finite, check_passive_links
from svkc.optimize.compilation import compile_problem
from svkc.optimize.controls import AbstractControls
from svkc.optimize.encoding import encode
from svkc.optimize.equations import Params
from svkc.optimize.failures import raise_on_failure
from svkc.optimize.free_args import ArgsModel
from svkc.optimize.guesses import Guess, PoseLine, motion_without_torques
from svkc.optimize.ipopt import AbstractSolver, Ipopt, SolverResult
from svkc.optimize.multistart import Solutions, multistart
from svkc.optimize.phases import Phase, as_constraint
from svkc.optimize.program import Program
from svkc.optimize.resampling import as_guess
from svkc.optimize.schemes import Radau
from svkc.optimize.solution import Solution, solution
from svkc.optimize.structures import phase_structures
from svkc.optimize.units import Units, units_of


class Problem:
    """An optimal control problem over phases of different structure, one after another.

    chain: the chain.
    phases: phases of the motion, in order.
    controls: `TorqueRates`, `Torques` or `Parametrized`.
    running: running cost (cost per second), a function of a `Point`; None: no such cost.
    final: cost at the end of the motion, a function of a `Point`; None: no such cost.
    bounds: bounds on coordinates at all nodes of all phases, from `between`.
    scheme: collocation scheme; None: `Radau(2)`.
    args: data for the functions of the problem, which read them as `point.args`.
    free: bounds (lower, upper) of the args that the solver chooses, by name. `args` must then be a
        dict that has these names; its values there are the default guess.
    chain_from: function (chain, args) -> chain that returns the chain for some args; None: the
        chain does not depend on args.
    units: `Units` by which the solver divides; None: from mass, length and gravity.
    project: whether nodes are projected onto their loops. False: the equations of motion keep
        accelerations on the loops, but positions and velocities drift off over the intervals.

    Raises ValueError if an argument has another form, or if a name is unknown.
    """

    def __init__(
        self,
        chain: Chain,
        phases: Sequence[Phase] | Phase,
        *,
        controls: AbstractControls,
        running: Checked[Function | None] = None,
        final: Checked[Function | None] = None,
        bounds: Sequence[Any] = (),
        scheme: Radau | None = None,
        args: Any = None,
        free: Mapping[str, Any] | None = None,
        chain_from: Checked[Function | None] = None,
        units: Units | None = None,
        project: bool = True,
    ):
        check_chain(chain)
        check_passive_links(chain)
        phases = [phases] if isinstance(phases, Phase) else list(phases)
        bounds = tuple(as_constraint("bounds", i, entry) for i, entry in enumerate(bounds))
        self.controls: AbstractControls = controls.for_chain(chain)
        # floats become arrays: `Solution.gradient` differentiates by them
        as_data = lambda x: jnp.asarray(x) if isinstance(x, float) else x
        self.args: Any = jax.tree.map(as_data, args)
        if chain_from is not None:
            check_function("chain_from", chain_from, "chain", "args")
        self.args_model: ArgsModel = ArgsModel(chain, self.args, free or {}, chain_from)
        self.chain: Chain = self.args_model.resolve(Params(chain, self.args)).chain
        self.phases: list[Phase] = [
            dataclasses.replace(p, bounds=(*bounds, *p.bounds)) for p in phases
        ]
        names = [p.name for p in phases]
        if not phases or len(set(names)) < len(names):
            raise ValueError(f"phases: expected phases of different names, got {names}")
        for name, function in (("running", running), ("final", final)):
            if function is not None:
                check_function(name, function, "point")
        self.running = running
        self.final = final
        self.scheme: Radau = Radau() if scheme is None else scheme
        middle = sum(sum(p.duration) / 2 for p in phases)
        self.units: Units = units_of(self.chain, middle) if units is None else units
        self.project: bool = boolean("project", project)
        self._programs: dict[Any, Program] = {}
        # compiled functions that problems on other meshes share
        self.functions: dict[str, Any] = {}

    def guess(
        self,
        poses: Sequence[Any],
        durations: Any = None,
        *,
        free: Mapping[str, Any] | None = None,
        noise: float = 0.0,
        key: int = 0,
    ) -> Guess:
        """Return a guess with straight lines between poses.

        Torques and accelerations are zero. Connected links carry the weight.

        poses: pose at the start of each phase, then the pose at the end of the motion. A pose is an
            array of the tree's coordinates, a dict by joint name, or a State. None: not known; the
            line leads on to the next known pose. Newton steps close the loops of known poses.
        durations: durations of the phases (s); None: the middle of their bounds.
        free: values of free args by name; of others, the values in `args`.
        noise: unknowns move at random by at most this fraction of the range between their bounds.
        key: seed of the random numbers.
        Raises ValueError for a wrong number of poses or of durations, and for unknown names.
        """
        chain = self.with_free(self.args_model.numbers(self.args, free)).chain
        count = len(self.phases)
        middle = [sum(p.duration) / 2 for p in self.phases]
        durations = np.asarray(middle if durations is None else durations, float)
        if durations.shape != (count,):
            raise ValueError(
                f"guess: got durations of shape {durations.shape}, expected one for each phase:"
                f" ({count},)"
            )
        if not np.all((durations > 0) & np.isfinite(durations)):
            raise ValueError(f"guess: got the durations {durations}, expected positive numbers")
        lines = PoseLine(chain, self.phases, poses).at(durations)
        motions = [
            motion_without_torques(chain, self.controls, self.scheme, phase, duration, line)
            for phase, duration, line in zip(self.phases, durations, lines)
        ]
        return Guess(motions, noise=noise, key=key, free=dict(free or {}))

    def solve(
        self,
        guess: Guess | Solution,
        *,
        solver: AbstractSolver | None = None,
        progress_meter: Any = None,
        throw: bool = True,
    ) -> Solution:
        """Return the optimal motion near a guess.

        A `Solution` as guess starts the solver warm: from its unknowns and, on the same mesh, its
        multipliers. Ctrl-C ends the run, and the last iterate is returned. Exceptions that users'
        functions raise are raised again.

        guess: from `guess`, or a `Solution` of a problem with these phases, on any mesh.
        solver: an `Ipopt` or an `InteriorPoint`; None: `Ipopt()`.
        progress_meter: a progress meter of diffrax; None: no display.
        throw: whether to raise RuntimeError if the solver fails. False: the last iterate is
            returned, and its `result` says how the run ended.

        Raises ValueError, with the name of the row, if a row or a derivative is not finite at the
        guess. Raises RuntimeError, with the rows that are violated most, if the solver fails.
        """
        program, start = self.start(guess)
        check_finite(program, start.x)
        meter = None if progress_meter is None else [progress_meter, progress_meter.init()]

        def progress(fraction: float) -> None:
            if meter is not None:
                meter[1] = meter[0].step(meter[1], jnp.asarray(fraction))

        solver = Ipopt() if solver is None else solver
        result = solver.solve(program, start, isinstance(guess, Solution), progress)
        if meter is not None:
            meter[0].close(meter[1])
        if throw and result.status != "interrupted":
            raise_on_failure(program, result)
        return solution(self, program, result)

    def with_mesh(self, meshes: Sequence[Any]) -> "Problem":
        """Return the problem with another mesh for each phase.

        meshes: for each phase, the number of equal intervals, or the positions of the nodes as
            fractions of the duration, from 0 to 1.
        Raises ValueError for a wrong number of meshes, and for a wrong mesh.
        """
        if len(meshes) != len(self.phases):
            raise ValueError(f"with_mesh: got {len(meshes)} meshes, expected {len(self.phases)}")
        problem = copy.copy(self)
        of_phase = lambda mesh: (
            {"mesh": mesh} if np.ndim(mesh) else {"mesh": None, "intervals": mesh}
        )
        problem.phases = [
            dataclasses.replace(phase, **of_phase(mesh))
            for phase, mesh in zip(self.phases, meshes, strict=True)
        ]
        problem._programs, problem.functions = {}, self.functions
        return problem

    def with_free(self, numbers: np.ndarray) -> "Problem":
        """Return the problem with other values of the free args, and with the chain for these.

        numbers: values of all free args, flattened, in the order of `free`.
        """
        if not self.args_model.names:
            return self
        problem, params = copy.copy(self), Params(self.args_model.chain, self.args)
        problem.chain, problem.args = self.args_model.resolve(params, numbers)
        return problem

    def multistart(
        self,
        guesses: Sequence[Guess | Solution],
        *,
        processes: Integer = 1,
        solver: AbstractSolver | None = None,
        progress_meter: Any = None,
    ) -> Solutions:
        """Return the solutions from several guesses, in the order of the guesses.

        Runs that failed are in the list as well: `result` of a solution says how its run ended.

        guesses: each as in `solve`.
        processes: 1: guesses are solved in this process, one after the other, with one compiled
            program. More: they are shared among this number of new processes. Each process compiles
            the problem for itself. Needs cloudpickle.
        solver, progress_meter: as in `solve`.
        Raises ImportError without cloudpickle. Raises RuntimeError, with the text of the exception,
        if a process fails.
        """
        count = integer("processes", processes, 1)
        return multistart(
            self, guesses, processes=count, solver=solver, progress_meter=progress_meter
        )

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes for pickling, without compiled functions."""
        return self.__dict__ | {"_programs": {}, "functions": {}}

    def start(self, guess: Guess | Solution) -> tuple[Program, SolverResult]:
        """Return the compiled problem, and the guess as a start of the solver, in its units."""
        motion = as_guess(guess, self)
        numbers = self.args_model.numbers(self.args, motion.free)
        problem = self.with_free(numbers)
        program = problem.program(motion)
        program.set_references([m.q for m in motion.phases])
        x = encode(program.transcription, motion, problem.chain, numbers) / program.unit
        rows, lower, upper = np.zeros(program.cost_row), np.zeros(len(x)), np.zeros(len(x))
        known = guess.multipliers if isinstance(guess, Solution) else None
        if known is not None and (len(known.rows), len(known.lower)) == (len(rows), len(x)):
            rows, lower, upper = known.rows, known.lower, known.upper
        return program, SolverResult(x=x, multipliers=rows, lower=lower, upper=upper)

    def check(self, guess: Guess | Solution) -> Check:
        """Return size, derivative errors, units and violated rows of the problem at a guess.

        guess: as in `solve`.
        Raises ValueError, with the name of the row, if a row or a derivative is not finite.
        """
        program, start = self.start(guess)
        return check(program, start.x)

    def program(self, guess: Guess) -> Program:
        """Return the compiled problem. The guess determines ranks of loops, and charts."""
        poses = [[m.q[0], m.q[-1]] for m in guess.phases]
        rows, structures = phase_structures(self.chain, self.phases, poses)
        key = (rows.tobytes(), *(s.active.tobytes() for s in structures))
        if key not in self._programs:
            self._programs[key] = compile_problem(self, rows, structures, guess)
        return self._programs[key]
