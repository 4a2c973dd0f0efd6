"""The backflip solved by `svkc.optimize`, from the same points as CasADi's program.

The transcription is the same: `Radau(2)`, without projection at the nodes.
"""

import pathlib
import tempfile
import time

import jax

jax.config.update("jax_enable_x64", True)

import backflip
import numpy as np
from backflip import FREEDOMS, PHASES, SHAPES
from optimize_casadi import STATISTICS, Solve, seconds

from svkc import optimize
from svkc.optimize.guesses import Guess, PhaseMotion
from svkc.scenes.backflip import backflip as figure
from svkc.scenes.backflip_problem import backflip_problem
from svkc.tree.spatial import quat_matrix

# link of a connection, and the sign of its force: the hands have the opposite one of the shanks
LINKS = {"toe": (0, 1), "shank": (1, -1)}


class Backflip:
    """The problem, with all its functions compiled in `seconds` of the processor."""

    def __init__(self, **options):
        begin = time.process_time()
        self.chain, _ = figure()
        self.problem = backflip_problem(self.chain, scheme=optimize.Radau(2), project=False)
        self.turns = [np.asarray(quat_matrix(x)) for x in self.chain.structure.quat]
        self.log = pathlib.Path(tempfile.mkdtemp()) / "ipopt.txt"
        options = options | STATISTICS | {"output_file": str(self.log)}
        self.solver = optimize.Ipopt(tolerance=1e-6, max_seconds=300.0, options=options)
        for function in self.functions(backflip.straight_line_guess()).values():
            function()
        self.seconds = time.process_time() - begin

    def solve(self, start: dict) -> Solve:
        """Solve from a point."""
        begin = time.perf_counter()
        solution = self.problem.solve(self.guess(start), solver=self.solver, throw=False)
        return Solve(
            point=self.point(solution.motion),
            cost=float(solution.cost),
            violation=float(solution.violation),
            iterations=int(solution.iterations),
            status=str(solution.result),
            wall_s=time.perf_counter() - begin,
            **seconds(self.log),
        )

    def functions(self, at: dict) -> dict:
        """Return calls of the functions that IPOPT calls, at a point."""
        program, start = self.problem.start(self.guess(at))
        multipliers = np.ones(program.cost_row + 1)
        return {
            "rows": lambda: program.rows(start.x),
            "Jacobian": lambda: program.jacobian(start.x),
            "Hessian": lambda: program.hessian(start.x, multipliers),
        }

    def guess(self, at: dict) -> Guess:
        """Return a point as a guess of svkc."""
        motions = []
        for p, phase in enumerate(PHASES):
            q, v, tau = np.split(at["x"][backflip.nodes(p)], [FREEDOMS, 2 * FREEDOMS], axis=1)
            i = backflip.intervals(p)
            landing = at["impulse"] * (phase.name == "landing")
            motion = PhaseMotion(
                duration=at["durations"][p],
                q=q,
                v=v,
                states=tau,
                blocks=np.stack([tau[:-1], at["u"][i]], axis=1),
                vdot=at["a"][i],
                forces=self._multipliers(phase.connection, at["f"][i]),
                impulse=self._multipliers(phase.connection, landing),
            )
            motions.append(motion)
        return Guess(motions)

    def point(self, motions) -> dict:
        """Return motions of phases as a point."""
        result = {name: np.zeros(shape) for name, shape in SHAPES.items()}
        for p, (phase, motion) in enumerate(zip(PHASES, motions, strict=True)):
            n, i = backflip.nodes(p), backflip.intervals(p)
            result["durations"][p] = motion.duration
            result["x"][n] = np.concatenate([motion.q, motion.v, motion.states], axis=1)
            result["u"][i], result["a"][i] = motion.blocks[:, 1], motion.vdot
            if phase.connection:
                result["f"][i] = self._force(phase.connection, motion.forces)
        result["impulse"] = self._force("toe", motions[-1].impulse)
        return result

    def _multipliers(self, connection: str | None, force: np.ndarray) -> np.ndarray:
        """Return the multipliers of all links of a force along y and z."""
        result = np.zeros((*force.shape[:-1], 12))
        if connection:
            link, sign = LINKS[connection]
            result[..., 6 * link + 3 : 6 * link + 6] = sign * force @ self.turns[link][1:]
        return result

    def _force(self, connection: str, multipliers: np.ndarray) -> np.ndarray:
        """Return the force along y and z."""
        link, sign = LINKS[connection]
        linear = np.asarray(multipliers)[..., 6 * link + 3 : 6 * link + 6]
        return sign * linear @ self.turns[link][1:].T
