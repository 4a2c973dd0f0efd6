"""MuJoCo's models and runs of the accuracy problems.

Loops are soft equality constraints, as stiff as a time constant of two time steps allows.
"""

import pathlib
import sys

import mujoco
import numpy as np

# the reference problems of the tests
sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "tests" / "references"))

import maximal
import reference_problems as reference

import svkc.scenes
from svkc.scenes.swing import model_and_links

INTEGRATORS = ("Euler", "implicitfast", "RK4")


def mechanism_model(problem, problem_data: dict, dt: float):
    """Return the MjModel of a mechanism described body by body.

    Joints that close loops are `connect` constraints, springs are tendons.
    """
    xml, bodies, _, loops = maximal.mjcf(problem_data)
    numbers, equalities, sites, tendons = maximal._numbers, "", {}, ""
    for joint in loops:
        parent = bodies[joint["parent"]]
        anchor = parent.rotation.T @ (np.array(joint["point_world0"]) - parent.position)
        first, second = (
            "world" if name == "ground" else name for name in (joint["parent"], joint["child"])
        )
        equalities += (
            f'<connect body1="{first}" body2="{second}" anchor="{numbers(anchor)}" solref="{2 * dt}'
            ' 1"/>'
        )
    for i, spring in enumerate(
        force for force in problem_data.get("forces", ()) if force["type"] == "spring_damper"
    ):
        for end in ("parent", "child"):
            body = bodies[spring[end]]
            local = body.rotation.T @ (np.array(spring[f"point_{end}_world0"]) - body.position)
            sites.setdefault(spring[end], []).append(
                f'<site name="{end}{i}" pos="{numbers(local)}"/>'
            )
        tendons += (
            f'<spatial stiffness="{spring["stiffness"]}"'
            f' springlength="{spring["rest_length"]}"><site site="parent{i}"/><site'
            f' site="child{i}"/></spatial>'
        )
    for name, elements in sites.items():
        opening_tag = (
            "<worldbody>"
            if name == "ground"
            else xml[xml.index(f'<body name="{name}"') :].split(">")[0] + ">"
        )
        xml = xml.replace(opening_tag, opening_tag + "".join(elements), 1)
    return mujoco.MjModel.from_xml_string(
        xml.replace(
            "</mujoco>", f"<tendon>{tendons}</tendon><equality>{equalities}</equality></mujoco>"
        )
    )


def figure_model(problem, spec: mujoco.MjSpec, dt: float):
    """Return the MjModel of a model and the virtual links that are connected at the problem's
    start.

    A hinge is two `connect` constraints, a ball is one, a slide is a `weld` to a sled of one gram.
    """
    chain, s = problem.chain, problem.state.structure
    rows = dict(zip(chain.topology.body_row, chain.body_names))
    body = lambda row: spec.worldbody if rows[int(row)] == "world" else spec.body(rows[int(row)])
    for i, name in enumerate(chain.link_names):
        rotations, translations = (
            np.flatnonzero(s.freedoms[i, :3]),
            np.flatnonzero(s.freedoms[i, 3:]),
        )
        ends = [
            (body(s.parent[i]), s.pos[i], s.quat[i]),
            (body(s.real[i]), s.real_pos[i], s.real_quat[i]),
        ]
        kind = mujoco.mjtEq.mjEQ_WELD if translations.size else mujoco.mjtEq.mjEQ_CONNECT
        if translations.size:
            sled = ends[0][0].add_body(
                name=name, pos=ends[0][1], quat=ends[0][2], mass=1e-3, inertia=[1e-6] * 3
            )
            sled.add_joint(
                name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=np.eye(3)[translations[0]]
            )
            ends[0] = (sled, np.zeros(3), np.array([1.0, 0, 0, 0]))
        for side in (-0.05, 0.05) if rotations.size == 1 else (0.0,):
            for label, (holder, place, quat) in zip(("parent", "real"), ends):
                offset = np.zeros(3)
                mujoco.mju_rotVecQuat(
                    offset,
                    side * np.eye(3)[rotations[0] if rotations.size else 0],
                    np.asarray(quat, float),
                )
                holder.add_site(
                    name=f"{name}{side}{label}",
                    pos=np.asarray(place) + offset,
                    quat=np.asarray(quat, float),
                )
            sites = {"name1": f"{name}{side}parent", "name2": f"{name}{side}real"}
            equality = spec.add_equality(
                name=f"{name}{side}", type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, **sites
            )
            equality.solref = [2 * dt, 1]
    return spec.compile()


MODELS = {
    "n_four_bar": lambda problem, dt: mechanism_model(problem, reference.n_four_bar(2), dt),
    "andrews": lambda problem, dt: mechanism_model(
        problem, reference.load_reference("andrews")["problem"], dt
    ),
    "high_bar": lambda problem, dt: figure_model(
        problem, mujoco.MjSpec.from_file(str(svkc.scenes.FOLDER / "figure16.xml")), dt
    ),
    "swing": lambda problem, dt: figure_model(problem, model_and_links()[0], dt),
}


class Run:
    """MuJoCo's run of a problem. A call returns the final qpos in the order of the chain's q.

    Links are released at the times of the reference run.

    gap: largest loop gap at releases and at the end.
    drift: change of energy minus the work of the torques (J).
    """

    def __init__(self, problem, name: str, integrator: str, dt: float):
        chain, state = problem.chain, problem.state
        self.model = model = MODELS[name](problem, dt) if name in MODELS else chain.model.model
        self.released = {}
        for time, links in problem.released:
            self.released.setdefault(time, []).extend(
                i for i in range(model.neq) if model.equality(i).name.startswith(links)
            )
        # an integer number of steps to each release, and to the end
        self.stops = [*sorted(self.released), problem.end]
        self.steps = sum(round((b - a) / dt) for a, b in zip([0.0, *self.stops], self.stops))
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
        model.opt.disableflags |= (
            mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
        )
        self.data, self.dt, self.start = (
            mujoco.MjData(model),
            dt,
            (np.zeros(model.nq), np.zeros(model.nv)),
        )
        self.torque, self.gap, self.drift = np.zeros(model.nv), 0.0, 0.0
        self.order = self._coordinate_indices(chain)
        self.start[0][self.order[0]], self.start[1][self.order[1]] = (
            state.q[: chain.nq],
            state.v[: chain.nv],
        )
        for i in (i for i in range(model.njnt) if model.joint(i).name in chain.link_names):
            row = chain.dof_names.index(model.joint(i).name)
            self.start[0][model.jnt_qposadr[i]], self.start[1][model.jnt_dofadr[i]] = (
                state.q[row + chain.nq - chain.nv],
                state.v[row],
            )
        for dof, torque in problem.torques.items():
            self.torque[model.joint(dof).dofadr] = torque

    def _coordinate_indices(self, chain):
        """Return the indices in qpos and qvel of the q and v of the chain's tree."""
        tree_joints = [
            i for i in range(self.model.njnt) if self.model.joint(i).name not in chain.link_names
        ]
        joint_nq_nv = {mujoco.mjtJoint.mjJNT_FREE: (7, 6), mujoco.mjtJoint.mjJNT_BALL: (4, 3)}
        q, v = [], []
        for i in tree_joints:
            nq, nv = joint_nq_nv.get(mujoco.mjtJoint(self.model.jnt_type[i]), (1, 1))
            q += range(self.model.jnt_qposadr[i], self.model.jnt_qposadr[i] + nq)
            v += range(self.model.jnt_dofadr[i], self.model.jnt_dofadr[i] + nv)
        return q, v

    def _energy(self) -> float:
        """Return the energy minus the work of the constant torques (J)."""
        mujoco.mj_forward(self.model, self.data)
        mujoco.mj_energyPos(self.model, self.data)
        mujoco.mj_energyVel(self.model, self.data)
        driven = self.model.jnt_qposadr[self.model.dof_jntid[self.torque != 0]]
        return self.data.energy.sum() - self.torque[self.torque != 0] @ self.data.qpos[driven]

    def __call__(self):
        model, data = self.model, self.data
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.qfrc_applied[:], self.gap = *self.start, self.torque, 0.0
        initial_energy = self._energy()
        for segment_start, stop in zip([0.0, *self.stops], self.stops):
            steps = max(round((stop - segment_start) / self.dt), 1)
            model.opt.timestep = (stop - segment_start) / steps
            mujoco.mj_step(model, data, steps)
            self.gap = max(self.gap, float(np.abs(data.efc_pos).max()) if data.nefc else 0.0)
            data.eq_active[self.released.get(stop, [])] = 0
        self.drift = self._energy() - initial_energy
        return data.qpos[self.order[0]].copy()
