"""The result of an optimization (`Solution`), and how it ended (`OUTCOME`)."""

from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from svkc._jax.enumerations import member_names
from svkc.model.annotations import Path
from svkc.model.chain import State, Structure
from svkc.model.names import link_index, unknown_name
from svkc.model.tables import Block, Printed, Table, as_text, number
from svkc.model.validation import boolean, positive_scalar
from svkc.optimize.archive import save_solution
from svkc.optimize.certificate import SolutionReport, report
from svkc.optimize.encoding import decode
from svkc.optimize.feedback import riccati_gains
from svkc.optimize.guesses import PhaseMotion
from svkc.optimize.ipopt import SolverResult
from svkc.optimize.linearization import LinearMaps, linear_maps
from svkc.optimize.phases import Phase
from svkc.optimize.points import placed_as_in, states_of
from svkc.optimize.program import Program
from svkc.optimize.refinement import refined
from svkc.optimize.replay import control_and_plan, replay
from svkc.simulation.trajectory import Trajectory
from svkc.tree.spatial import quat_matrix

if TYPE_CHECKING:  # equinox annotates the metaclass of its enumerations in this way
    from enum import EnumMeta as NamedMeta
else:
    from svkc._jax.enumerations import NamedMeta


class OUTCOME(eqx.Enumeration, metaclass=NamedMeta):  # pyright: ignore
    """How an optimization ended."""

    successful = "The optimality conditions hold to the tolerance."
    acceptable = "The optimality conditions hold to IPOPT's acceptable tolerance."
    infeasible = "The solver converged to a point that violates constraints."
    max_iterations = "The solver reached its largest number of iterations."
    max_time = "The solver reached its largest wall time."
    interrupted = "The run was interrupted; the motion is the last iterate."
    not_finite = "A row or a derivative is not finite."
    failed = "The solver could not go on from its last iterate."


class Multipliers(eqx.Module):
    """Lagrange multipliers at a solution, in the solver's units.

    rows: of the constraint rows. lower, upper: of the bounds of the unknowns.
    """

    rows: Any
    lower: Any
    upper: Any


class Solution(Printed):
    """An optimized motion.

    cost: cost of the motion on this mesh.
    violation: largest violation of a row, in the solver's units.
    durations: durations of the phases (s).
    ts: [nodes] times (s) of the nodes of all phases. The time between two phases is there twice,
        before and after the change of structure.
    states: states at these times.
    motion: q, v, controls, accelerations and multipliers of each phase.
    multipliers: Lagrange multipliers of rows and bounds.
    iterations: number of iterations of the solver.
    seconds: (wall time of the solver, part of this time in rows and derivatives).
    result: how the optimization ended.
    structures: structures of the phases.
    cost_error: difference of the costs on the last two meshes of `refined`; NaN if not refined.
    problem: the problem, with the mesh of this solution, and with the optimal free args.
    """

    cost: Any
    violation: Any
    durations: Any
    ts: Any
    states: State
    motion: tuple[PhaseMotion, ...]
    multipliers: Multipliers
    iterations: Any
    seconds: Any
    result: OUTCOME
    structures: tuple[Structure, ...]
    cost_error: Any
    problem: Any = eqx.field(static=True)

    def _blocks(self) -> list[Block]:
        names = [phase.name for phase in self.problem.phases]
        rows = [
            (name, number(m.duration), str(len(m.vdot)))
            for name, m in zip(names, self.motion, strict=True)
        ]
        words = (
            f"cost {float(self.cost):.8g} on this mesh, largest violation"
            f" {float(self.violation):.2g}, {int(self.iterations)} iterations in"
            f" {float(self.seconds[0]):.3g} s ({float(self.seconds[1]):.3g} s in functions):"
            f" {self.result}"
        )
        names = self.problem.args_model.names
        free = [f"{name}: {np.array2string(np.asarray(self.args[name]))}" for name in names]
        return [words, *free, Table(("phase", "duration (s)", "intervals"), rows)]

    @property
    def args(self) -> Any:
        """Args of the problem, with the optimal values of the free ones."""
        return self.problem.args

    def __str__(self) -> str:
        return as_text(self._blocks())

    def __repr__(self) -> str:
        return f"<Solution: cost {float(self.cost):.8g}, {self.result}>"

    def forces(self, link: str, phase: str | None = None) -> Any:
        """Return the force (N) [stages 3] of a virtual link at all stages of the phases that
        connect it: on `real` from `parent`, in axes of the parent body.

        link: name of the virtual link. phase: name of a phase; None: all that connect the link.
        Raises ValueError for unknown names, and for a link that is not connected.
        """
        pairs = list(zip(self.problem.phases, self.motion, strict=True))
        if phase is not None:
            pairs = [self._phase(phase)[:2]]
        parts = [
            self._force(link, m.forces).reshape(-1, 3) for own, m in pairs if link in own.connected
        ]
        if not parts:
            connected = tuple(name for own, _ in pairs for name in own.connected)
            raise unknown_name("virtual link", link, connected)
        return np.concatenate(parts)

    def stage_times(self, phase: str) -> np.ndarray:
        """Return the times (s) [stages] of the stages of a phase, in the order of `forces`.

        phase: name of the phase.
        Raises ValueError for an unknown name.
        """
        _, m, start = self._phase(phase)
        steps = np.diff(m.times)[:, None]
        return start + (m.times[:-1, None] + steps * self.problem.scheme.c).ravel()

    def _phase(self, name: str) -> tuple[Phase, PhaseMotion, float]:
        """Return a phase, its motion and its start (s). Raises ValueError for unknown names."""
        names = [p.name for p in self.problem.phases]
        if name not in names:
            raise unknown_name("phase", name, names)
        i = names.index(name)
        return self.problem.phases[i], self.motion[i], float(np.sum(self.durations[:i]))

    def report(self, replay: bool = True) -> SolutionReport:
        """Return the report on how far the solution is from a motion of the chain.

        Each interval is simulated with error control from its first node. Then each phase is
        simulated with the planned torques alone, and the whole motion with feedback.

        replay: whether to simulate phases and the whole motion as well.
        """
        return report(self, replay)

    def refined(
        self, tol: float = 1e-3, *, rounds: int = 4, solver: Any = None, progress_meter: Any = None
    ) -> "Solution":
        """Return the solution on finer meshes, solved until the defects are below a tolerance.

        Intervals with defects above the tolerance are split; neighbours far below it are joined.
        Each mesh is solved warm from the previous solution. `cost_error` of the result is the
        difference of the costs on the last two meshes.

        tol: largest defect of a position (rad, m). That of a velocity is ten times this number.
        rounds: largest number of meshes. The last one may still have defects above the tolerance.
        solver, progress_meter: as in `Problem.solve`.
        """
        options = {"solver": solver, "progress_meter": progress_meter}
        return refined(self.problem, self, positive_scalar("tol", tol), rounds, options)

    def trajectory(self, ts: Any = None, *, feedback: bool = True, **options: Any) -> Trajectory:
        """Return the motion as a run of `svkc.simulate`, with events between the phases.

        ts: save times (s); None: 101 times over the motion.
        feedback: whether feedback torques are added, as in `control`.
        options: keyword arguments of `svkc.simulate`.
        """
        return replay(self, boolean("feedback", feedback), ts, options)

    def control(self, *, feedback: bool = True) -> tuple[Any, Any]:
        """Return (function, args): a control (t, state, args) -> tau of `svkc.simulate`.

        All solutions of a problem share the function; the args are the plan. Feedback adds torques
        of the driven coordinates that are linear in the error of q and v. Gains are those of a
        time-varying LQR along the plan: they minimize the integral of the squared errors (in rad
        and m, velocities divided by `units.velocity`) plus 0.01 of the squared torques (divided by
        `units.torque`), plus the squared errors at the end times 1 s. The linear model includes
        connected links and impacts. Bounds of torques do not limit the sum. `Parametrized` has no
        feedback, because its torques are an arbitrary function.

        feedback: False: the planned torques alone. An unstable phase then leaves the plan.
        """
        return control_and_plan(self, boolean("feedback", feedback))

    def linear_maps(self) -> LinearMaps:
        """Return the linear maps of the intervals, for small errors of the state."""
        return linear_maps(self.problem, self.motion)

    def gains(self) -> np.ndarray:
        """Return the gains of the feedback [intervals 2 driven 2nv], at both ends of intervals.

        They map errors of q and v of the tree (plan minus state) to torques of the driven
        coordinates (N m/rad, N m s/rad).
        """
        return riccati_gains(self.problem, self.motion, self.linear_maps())

    def save(self, path: Path) -> None:
        """Write the solution to one .npz file, which `optimize.load_solution` reads.

        The file holds numbers and names, but no functions: reading needs the problem.

        path: of the file.
        Raises OSError if the file cannot be written.
        """
        names = member_names(OUTCOME)
        save_solution(self, names[int(np.asarray(self.result._value))], path)

    def gradient(self) -> Any:
        """Return the derivatives of the optimal cost by the chain's floats and by args.

        The result is a pair (chain, args) with derivatives as leaves, and None for other leaves. By
        the envelope theorem they are the derivatives of the Lagrangian. They hold while the set of
        active bounds does not change.
        """
        program, start = self.problem.start(self)
        return program.parameter_gradient(start.x, self.multipliers.rows)

    def impulse(self, phase: str, link: str | None = None) -> Any:
        """Return the impulse (N s) [3] of a virtual link in the impact at the start of a phase.

        It acts on `real` from `parent`. Components are along the axes of the parent body.

        phase: name of the phase. link: name of the link; None: the only one of the phase.
        Raises ValueError for unknown names.
        """
        own, motion, _ = self._phase(phase)
        connected = own.connected
        link = connected[0] if link is None and len(connected) == 1 else link
        if link is None or link not in connected:
            raise unknown_name("virtual link", str(link), connected)
        return self._force(link, motion.impulse)

    def _force(self, link: str, multipliers: np.ndarray) -> np.ndarray:
        """Return the force [... 3] of a link, in the parent's axes, from all links' multipliers."""
        chain = self.problem.chain
        i = link_index(chain.topology, link)
        turn = np.asarray(quat_matrix(chain.structure.quat[i]))
        return multipliers[..., 6 * i + 3 : 6 * i + 6] @ turn.T


def solution(problem: Any, program: Program, result: SolverResult) -> Solution:
    """Return the `Solution` of a solver's result."""
    transcription, rows = program.transcription, program.rows(result.x)
    x = result.x * program.unit
    problem = problem.with_free(x[transcription.builder.free_args])
    return solution_of(
        problem,
        decode(transcription, x),
        [placed_as_in(problem.chain, s.structure) for s in transcription.structures],
        cost=rows[-1] * program.row_unit[-1],
        violation=np.max(program.violation(result.x), initial=0.0),
        multipliers=Multipliers(result.multipliers, lower=result.lower, upper=result.upper),
        iterations=np.asarray(result.iterations),
        seconds=np.array([result.seconds, result.functions]),
        result=OUTCOME._name_to_item[result.status],
        cost_error=np.asarray(np.nan),
    )


def solution_of(
    problem: Any, motion: tuple[PhaseMotion, ...], structures: list[Structure], **fields: Any
) -> Solution:
    """Return the `Solution` with this motion.

    structures: of the phases. fields: of `Solution` that do not follow from the motion.
    """
    ends = np.cumsum([m.duration for m in motion])
    ts = [end - m.duration + m.times for end, m in zip(ends, motion, strict=True)]
    states = states_of(problem.chain, structures, [(m.q, m.v) for m in motion])
    return Solution(
        durations=np.array([m.duration for m in motion]),
        ts=np.concatenate(ts),
        states=jax.tree.map(lambda *x: jnp.concatenate(x), *states),
        motion=motion,
        structures=tuple(structures),
        problem=problem,
        **fields,
    )
