"""Published problems as chains, and their independent solutions.

Each file in `data/` names the source of its problem and solution.
"""

import json
import pathlib

import diffrax
import jax
import jax.numpy as jnp
import maximal
import numpy as np

import svkc

FOLDER = pathlib.Path(__file__).parent / "data"
TOP_MJCF = (
    '<mujoco><compiler balanceinertia="false"/><option gravity="{}"/><worldbody><body'
    ' name="top"><joint name="top" type="ball"/>'
)
TOP_MJCF += '<inertial pos="{}" mass="{}" diaginertia="{}"/></body></worldbody></mujoco>'


def load_reference(name):
    """Return the contents of a data file."""
    return json.loads((FOLDER / f"{name}.json").read_text())


def tight_tolerances(tolerance):
    """Return options of `simulate`: Dopri8 with rtol `tolerance` and a hundredth of it as atol."""
    return {"rtol": tolerance, "atol": tolerance / 100, "solver": diffrax.Dopri8()}


def numbers(x):
    """Return numbers as MJCF text, with all digits."""
    return " ".join(repr(float(value)) for value in x)


def body_positions(chain, traj, body):
    """Return the positions of a body's frame, [times 3] (m)."""
    return np.asarray(jax.vmap(lambda s: svkc.poses(chain, s)[0])(traj.states))[
        :, chain.body_names.index(body)
    ]


def n_four_bar(windows):
    """Return the N four-bar problem with this number of windows."""
    problem = load_reference("n_four_bar")["problem"]
    upright, level = problem["bodies"][0], problem["bodies"][-1]
    hinge = {"type": "revolute", "axis_world0": [0, 0, 1]}
    bodies = [upright | {"name": f"vert{i}", "com_world0": [i, 0.5, 0]} for i in range(windows + 1)]
    bodies += [level | {"name": f"horiz{i}", "com_world0": [i + 0.5, 1, 0]} for i in range(windows)]
    joints = [
        hinge | {"parent": "ground", "child": f"vert{i}", "point_world0": [i, 0, 0]}
        for i in range(windows + 1)
    ]
    for i in range(windows):
        joints.append(
            hinge | {"parent": f"vert{i}", "child": f"horiz{i}", "point_world0": [i, 1, 0]}
        )
        joints.append(
            hinge | {"parent": f"horiz{i}", "child": f"vert{i + 1}", "point_world0": [i + 1, 1, 0]}
        )
    return problem | {"bodies": bodies, "joints": joints}


def spring_control(chain, problem):
    """Return a control that applies the springs and the torques of a problem."""

    def end_position(q, structure, body, point, name):
        position, quat = svkc.poses(chain, svkc.State(q, jnp.zeros(chain.dofs), structure))
        row = chain.body_names.index("world" if name == "ground" else name)
        local = body.rotation.T @ (np.asarray(point) - body.position)
        w, u = quat[row, 0], quat[row, 1:]
        return position[row] + local + 2 * jnp.cross(u, jnp.cross(u, local) + w * local)

    bodies = {body["name"]: maximal.Body(body) for body in problem["bodies"]} | {
        "ground": maximal.Body()
    }

    def potential(q, structure):
        total = 0.0
        for spring in (force for force in problem["forces"] if force["type"] == "spring_damper"):
            start, stop = (
                end_position(
                    q, structure, bodies[spring[e]], spring[f"point_{e}_world0"], spring[e]
                )
                for e in ("parent", "child")
            )
            total = (
                total
                + spring["stiffness"]
                / 2
                * (jnp.linalg.norm(stop - start) - spring["rest_length"]) ** 2
            )
        return total

    def control(t, state, args):
        torque = -svkc.tangent_gradient(
            chain, state.q, jax.grad(potential)(state.q, state.structure)
        )
        for force in (force for force in problem["forces"] if force["type"] == "torque"):
            torque = torque.at[chain.dof_names.index(force["body"])].add(force["world"][2])
        return torque

    return control
