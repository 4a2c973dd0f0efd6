"""A problem of motion optimization: phases, controls and costs."""

import copy
import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from svkc.model.annotations import Checked, Function, Integer
from svkc.model.chain import Chain
from svkc.model.checked_jit import check_chain
from svkc.model.validation import boolean, check_function, integer
from svkc.optimize.checks import Check, check, check_finite
from svkc.optimize.controls import AbstractControls
from svkc.optimize.encoding import encode
from svkc.optimize.equations import Model, Params
from svkc.optimize.failures import raise_on_failure
from svkc.optimize.guesses import Guess, PhaseMotion, PoseLine, static_forces
from svkc.optimize.ipopt import AbstractSolver, Ipopt, SolverResult
from svkc.optimize.lift import Layout
from svkc.optimize.loop_rows import LinkRows
from svkc.optimize.multistart import Solutions, multistart
from svkc.optimize.phases import Phase, as_constraint
from svkc.optimize.program import Program
from svkc.optimize.resampling import as_guess
from svkc.optimize.schemes import Radau
from svkc.optimize.solution import Solution, solution
from svkc.optimize.structures import phase_structures
from svkc.optimize.transcription import Transcription
from svkc.optimize.units import Units, units_of
from svkc.optimize.unknowns import UnknownsBuilder
from svkc.optimize.user_rows import UserRows

# points at which patterns are found, and the size of the scaled cost at them
_SAMPLES, _COST_AT_SAMPLES = 3, 50.0


class Problem:
    """A motion to be optimized: phases of different structure, one after another.

    chain: the chain.
    phases: of the motion, in order.
    controls: `TorqueRates`, `Torques` or `Parametrized`.
    running: running cost (1/s), a function of a `Point`.
    final: cost at the end of the motion, a function of a `Point`.
    bounds: of coordinates at all nodes, from `between`.
    scheme: `Radau(2)` or with another number of stages.
    args: passed to functions as `point.args`.
    units: `Units` by which the solver divides; None: from mass, length and gravity.
    project: whether nodes are projected onto their loops. Without it loops drift, as in equations
        of motion with accelerations alone.

    Raises ValueError if an argument has another form, or a name is unknown.
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
        units: Units | None = None,
        project: bool = True,
    ):
        check_chain(chain)
        phases = [phases] if isinstance(phases, Phase) else list(phases)
        bounds = tuple(as_constraint("bounds", i, entry) for i, entry in enumerate(bounds))
        self.chain: Chain = chain
        self.controls: AbstractControls = controls.for_chain(chain)
        # numbers are data, by which the optimal cost has derivatives
        as_data = lambda x: jnp.asarray(x) if isinstance(x, float) else x
        self.args: Any = jax.tree.map(as_data, args)
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
        self.units: Units = units_of(chain, middle) if units is None else units
        self.project: bool = boolean("project", project)
        self._programs: dict[Any, Program] = {}
        # functions that are made once, also for other meshes
        self.functions: dict[str, Any] = {}

    def guess(
        self, poses: Sequence[Any], durations: Any = None, *, noise: float = 0.0, key: int = 0
    ) -> Guess:
        """Return a guess: straight lines between poses, and the forces of statics.

        poses: at the start of each phase and at the end: coordinates of the tree as an array, by
            joint name, or a State. None where a pose is not known: the line goes on. The loops of
            the phases that meet there are closed by the least change.
        durations: of the phases (s); None: the middle of their bounds.
        noise: fraction of the range between bounds by which unknowns are moved at random.
        key: of the random numbers.
        Raises ValueError if poses or durations are of another number.
        """
        count = len(self.phases)
        middle = [sum(p.duration) / 2 for p in self.phases]
        durations = np.asarray(middle if durations is None else durations, float)
        if durations.shape != (count,):
            raise ValueError(f"guess: got {durations.size} durations, expected {count}")
        lines = PoseLine(self.chain, self.phases, poses).at(durations)
        return Guess([self._at_rest(*x) for x in zip(self.phases, durations, lines)], noise, key)

    def _at_rest(self, phase: Phase, duration: float, line: tuple) -> PhaseMotion:
        """Return a phase along a line, without torques and accelerations."""
        n, s, control = phase.intervals, self.scheme.stages, self.controls.count(self.chain)
        links, q = 6 * len(self.chain.link_names), line[0]
        forces = static_forces(self.chain, phase.connected, self.controls.driven(self.chain), q)
        return PhaseMotion(
            duration=float(duration),
            q=line[0],
            v=line[1],
            states=np.zeros((n + 1, control * self.controls.has_state)),
            blocks=np.zeros((n, self.controls.blocks(self.scheme), control)),
            vdot=np.zeros((n, s, self.chain.nv)),
            forces=np.repeat(forces[:-1, None], s, 1),
            impulse=np.zeros(links),
            mesh=phase.node_fractions,
        )

    def solve(
        self,
        guess: Guess | Solution,
        *,
        solver: AbstractSolver | None = None,
        progress_meter: Any = None,
        throw: bool = True,
    ) -> Solution:
        """Return the optimal motion near a guess.

        guess: of `guess`, or a `Solution` of a problem with these phases, on any mesh.
        solver: None: `Ipopt()`.
        progress_meter: of diffrax.
        throw: raise RuntimeError if the solver fails, with the names of the rows that are violated
            most. False returns the last iterate, whose `result` says how the run ended.

        Ctrl-C ends the run, and the result is the last iterate. Exceptions in functions of the user
        are raised. Raises ValueError if a row is not finite at the guess, by name.
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
        """Return the problem with other intervals.

        meshes: for each phase, the number of equal intervals, or the places of the nodes as
            fractions of the duration, from 0 to 1.
        Raises ValueError for another number of meshes, and for a wrong mesh.
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

    def multistart(
        self,
        guesses: Sequence[Guess | Solution],
        *,
        processes: Integer = 1,
        solver: AbstractSolver | None = None,
        progress_meter: Any = None,
    ) -> Solutions:
        """Return the solutions from several guesses, in their order, as a list with `best`.

        Those that failed are among them: `result` says how each ended.

        guesses: as of `solve`.
        processes: one: starts are solved here, one after the other in one compiled program. More:
            at once in so many new processes, which compile the problem first; needs cloudpickle.
        solver, progress_meter: as in `solve`.
        Raises RuntimeError, with the exception in it, if a process fails.
        """
        count = integer("processes", processes, 1)
        return multistart(
            self, guesses, processes=count, solver=solver, progress_meter=progress_meter
        )

    def __getstate__(self) -> dict[str, Any]:
        """Return what another process needs; compiled functions are made anew."""
        return self.__dict__ | {"_programs": {}, "functions": {}}

    def start(self, guess: Guess | Solution) -> tuple[Program, SolverResult]:
        """Return the compiled problem, and a guess in the solver's units."""
        motion = as_guess(guess, self)
        program = self.program(motion)
        program.set_references([m.q for m in motion.phases])
        x = encode(program.transcription, motion) / program.unit
        rows, count = np.zeros(program.cost_row), np.zeros(program.count)
        multipliers = guess.multipliers if isinstance(guess, Solution) else None
        if multipliers is not None and len(multipliers.rows) == len(rows):
            rows, lower, upper = multipliers.rows, multipliers.lower, multipliers.upper
        else:
            lower = upper = count
        return program, SolverResult(x=x, multipliers=rows, lower=lower, upper=upper)

    def check(self, guess: Guess | Solution) -> Check:
        """Return what is to know before any iteration: derivatives, units, violated rows.

        guess: as in `solve`.
        Raises ValueError if a row is not finite at the guess, by name.
        """
        program, start = self.start(guess)
        return check(program, start.x)

    def program(self, guess: Guess) -> Program:
        """Return the compiled problem about a guess, which gives ranks and charts."""
        poses = [[m.q[0], m.q[-1]] for m in guess.phases]
        rows, structures = phase_structures(self.chain, self.phases, poses)
        key = (rows.tobytes(), *(s.active.tobytes() for s in structures))
        if key not in self._programs:
            self._programs[key] = self._compile(rows, structures, guess)
        return self._programs[key]

    def _compile(self, rows: np.ndarray, structures, guess: Guess) -> Program:
        """Return the compiled problem for these structures."""
        chain, controls = self.chain, self.controls
        layout = Layout(
            nv=chain.nv,
            stages=self.scheme.stages,
            rows=len(rows),
            control=controls.count(chain),
            blocks=controls.blocks(self.scheme),
            stage_blocks=controls.stage_blocks,
        )
        builder = UnknownsBuilder(
            chain, controls, rows, scheme=self.scheme, units=self.units, project=self.project
        )
        transcription = Transcription(
            builder,
            self.phases,
            Model(layout, LinkRows.of(chain, rows), controls),
            scheme=self.scheme,
            structures=structures,
            references=[m.q for m in guess.phases],
        )
        builder.table.freeze()
        params = Params(chain, self.args)
        samples = self._sample_points(builder.table, transcription)
        users = UserRows(transcription, params, samples)
        last = len(self.phases) - 1
        for i, phase in enumerate(self.phases):
            running = [f for f in (self.running, phase.running) if f is not None]
            final = [f for f in (self.final if i == last else None, phase.final) if f is not None]
            users.add_phase(i, running, final)
        transcription.rows.freeze()
        users.set_cost_row(transcription.rows.count)
        program = Program(transcription, params, samples, self.units.cost or 1.0)
        if self.units.cost is None:
            costs = [abs(program.rows(x / program.unit)[-1]) for x in samples]
            program.set_cost_unit(max(float(np.median(costs)) / _COST_AT_SAMPLES, 1e-12))
        return program

    def _sample_points(self, table, transcription: Transcription) -> np.ndarray:
        """Return random points in SI units, the durations near the middle of their bounds."""
        random = np.random.default_rng(0)
        samples = random.normal(size=(_SAMPLES, table.count)) * table.unit
        for phase, indices in zip(self.phases, transcription.indices):
            middle = sum(phase.duration) / 2
            samples[:, indices.duration] = middle * random.uniform(0.8, 1.2, _SAMPLES)
        fixed = table.lower == table.upper
        return np.where(fixed, table.lower, samples)
