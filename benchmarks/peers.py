"""The libraries that speed.py compares svkc with: MuJoCo, Pinocchio, MJX and JaxSim.

MuJoCo and Pinocchio are called in this process. MJX and JaxSim each run in a separate process, on
one core. This file is the program of that process: it compiles, prints the compile times, and runs
all steps once for every line of its standard input.
"""

import json
import os
import pathlib
import select
import subprocess
import sys

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent.parent / "tests"))

import speed_cases
from programs import compile_steps
from speed_cases import DT

import svkc

USER_XLA_FLAGS, TIMEOUT = os.environ.get("XLA_FLAGS", ""), 60


def mujoco_runs(model, q, v, batch: int, steps: int):
    """Yield MuJoCo's `mj_step` on one core, or its `rollout` on all cores, as (label, function).

    Each call starts from the initial states.
    """
    data = mujoco.MjData(model)
    if batch == 1:

        def run():
            mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:] = q, v[0]
            mujoco.mj_step(model, data, steps)

        yield "MuJoCo", run
        return
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    start = np.zeros((batch, mujoco.mj_stateSize(model, kind)))
    for lane in range(batch):
        data.qpos[:], data.qvel[:] = q, v[lane]
        mujoco.mj_getState(model, data, start[lane], kind)
    threads = os.cpu_count()
    pool, workers = (
        mujoco.rollout.Rollout(nthread=threads),
        [mujoco.MjData(model) for _ in range(threads)],
    )
    yield (
        "MuJoCo rollout, all cores",
        lambda: pool.rollout([model] * batch, workers, start, nstep=steps),
    )


def pinocchio_runs(name: str, chain, state, batch: int, steps: int):
    """Yield Pinocchio's accelerations alone, called from Python on one core, as (label, function).

    An open chain uses `aba`. Grips use `constraintDynamics`: a ball is one point constraint, a
    hinge two. The accelerations are asserted to equal svkc's.
    """
    import pinocchio

    model = pinocchio.buildModelFromMJCF(speed_cases.model_path(name))
    data, calls = model.createData(), steps * batch
    at_rest = svkc.State(state.q, jnp.zeros_like(state.v), state.structure)
    q, v, force = (
        np.asarray(svkc.interop.quaternions_xyzw(chain, state.q))[: chain.nq],
        np.zeros(chain.nv),
        np.zeros(chain.nv),
    )
    models, datas = pinocchio.StdVec_RigidConstraintModel(), pinocchio.StdVec_RigidConstraintData()
    for constraint in _point_constraints(
        pinocchio, model, chain, state.structure, two_points="ball" not in name
    ):
        models.append(constraint)
        datas.append(constraint.createData())
    if not len(models):
        who, run = "Pinocchio, aba alone", lambda: pinocchio.aba(model, data, q, v, force)
    else:
        pinocchio.initConstraintDynamics(model, data, models, datas)
        proximal = pinocchio.ProximalSettings(1e-10, 1e-8, 10)
        who = "Pinocchio, constraintDynamics alone"
        grips = {"contact_models": models, "contact_datas": datas, "prox_settings": proximal}
        run = lambda: pinocchio.constraintDynamics(model, data, q, v, force, **grips)
    ours = np.asarray(svkc.forward_dynamics(chain, at_rest, jnp.zeros(chain.nv)))[6 : chain.nv]
    # Pinocchio's base accelerations are in other axes
    assert np.max(np.abs(ours - run()[6:])) < (1e-8 if ours.dtype == np.float64 else 0.1), (
        "Pinocchio's accelerations are not svkc's"
    )
    yield who, lambda: [run() for _ in range(calls)]


def _point_constraints(pinocchio, model, chain, structure, two_points: bool):
    """Yield Pinocchio's point constraints of each connected link.

    two_points: whether a link has two points, 1 m apart along its axis, which make a hinge.
    """
    frame = lambda quat, pos: pinocchio.SE3(
        pinocchio.Quaternion(*map(float, quat)).matrix(), np.asarray(pos, float)
    )
    names = {row: name for row, name in zip(chain.topology.body_row, chain.body_names, strict=True)}
    for k in np.flatnonzero(np.asarray(structure.connected)):
        body = model.frames[model.getFrameId(names[int(structure.real[k])])]
        body_placement, ground_placement = (
            frame(structure.real_quat[k], structure.real_pos[k]),
            frame(structure.quat[k], structure.pos[k]),
        )
        for offset in (0.0, 1.0) if two_points else (0.0,):
            shift = pinocchio.SE3(np.eye(3), np.array([0, 0, offset]))
            one, other = (
                (body.parentJoint, body.placement * body_placement * shift),
                (0, ground_placement * shift),
            )
            yield pinocchio.RigidConstraintModel(
                pinocchio.ContactType.CONTACT_3D,
                model,
                *one,
                *other,
                pinocchio.ReferenceFrame.LOCAL,
            )


class Process:
    """A separate process of one library, with XLA's default options, on one core."""

    def __init__(self, kind: str, name: str, dtype: str, batch: int, steps: int):
        env, case = (
            os.environ
            | {"XLA_FLAGS": USER_XLA_FLAGS, "JAX_ENABLE_X64": str(int(dtype == "float64"))},
            (kind, name, dtype, str(batch), str(steps)),
        )
        self.process = subprocess.Popen(
            [sys.executable, __file__, *case],
            env=env,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        answer = json.loads(self.process.stdout.readline())
        if "missing" in answer:
            self.process.wait()
            raise ImportError(answer["missing"])
        self.compile_stats = answer["compile_stats"]

    def __call__(self):
        """Run all steps. Raise TimeoutError if the process does not answer."""
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        if not select.select([self.process.stdout], [], [], TIMEOUT)[0]:
            self.process.kill()
            raise TimeoutError(f"a peer did not answer within {TIMEOUT} s")
        self.process.stdout.readline()

    def close(self):
        """End the process."""
        self.process.stdin.close()
        self.process.wait()


def mjx_steps(name: str, batch: int):
    """Return MJX's step of a case, and a batch of its states."""
    from mujoco import mjx

    chain, state = speed_cases.load_case(name)
    model, q, _ = speed_cases.mujoco_case(name, chain, state)
    v = jnp.asarray(speed_cases.random_states(chain, state, batch).v[:, : chain.nv])
    mjx_model = mjx.put_model(model)
    data = mjx.make_data(mjx_model)
    states = jax.vmap(lambda v: data.replace(qpos=jnp.asarray(q, v.dtype), qvel=v))(v)
    return lambda d: mjx.step(mjx_model, d), states


def jaxsim_program(name: str, batch: int, steps: int):
    """Return JaxSim's steps of the open figure, with three hinges for each ball.

    JaxSim has no ball joints, and closes loops by welds only.
    """
    import jaxsim.api as js
    import joints

    model = js.model.JaxSimModel.build_from_model_description(
        hinge_model_as_sdf(joints.hinges_for_balls()[0].compile()), time_step=DT, is_urdf=False
    )
    v = jax.random.normal(jax.random.key(0), (batch, model.dofs())) * 0.5
    # JaxSim has a ground: start far above it
    states = jax.vmap(
        lambda v: js.data.JaxSimModelData.build(
            model, base_position=jnp.array([0, 0, 1e3]), joint_velocities=v
        )
    )(v)
    return compile_steps(lambda d: js.model.step(model, d), states, steps)


def hinge_model_as_sdf(model: mujoco.MjModel) -> str:
    """Return a model whose joints are all hinges as SDF.

    SDF allows one hinge for each link: of several hinges on a body, all but the last get a link of
    0.1 gram.
    """
    numbers = lambda *x: " ".join(repr(float(y)) for y in x)
    elements, names = [], {0: None} | {b: model.body(b).name for b in range(1, model.nbody)}

    relative_to = lambda parent: f' relative_to="{parent}"'

    def link(name, parent, pos, mass, com, inertia):
        tags = "".join(
            f"<{tag}>{value!r}</{tag}>"
            for tag, value in zip(
                ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"), map(float, inertia), strict=True
            )
        )
        place = (
            f"<pose{'' if parent is None else relative_to(parent)}>{numbers(*pos, 0, 0, 0)}</pose>"
        )
        about = (
            f"<pose>{numbers(*com, 0, 0, 0)}</pose><mass>{mass!r}</mass><inertia>{tags}</inertia>"
        )
        elements.append(f'<link name="{name}">{place}<inertial>{about}</inertial></link>')

    for b in range(1, model.nbody):
        parent, pos = names[model.body_parentid[b]], model.body_pos[b]
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, model.body_iquat[b])
        inertia_in_body = rotation.reshape(3, 3) * model.body_inertia[b] @ rotation.reshape(3, 3).T
        body_inertia = (
            float(model.body_mass[b]),
            model.body_ipos[b],
            inertia_in_body[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]],
        )
        hinges = [
            j
            for j in range(model.njnt)
            if model.jnt_bodyid[j] == b and model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE
        ]
        for k, j in enumerate(hinges):
            last = k == len(hinges) - 1
            child = names[b] if last else f"{names[b]}_{k}"
            link(
                child,
                parent,
                pos,
                *(body_inertia if last else (1e-4, np.zeros(3), [1e-6] * 3 + [0.0] * 3)),
            )
            limit = "<limit><lower>-1e9</lower><upper>1e9</upper></limit>"
            axis = f"<axis><xyz>{numbers(*model.jnt_axis[j])}</xyz>{limit}</axis>"
            elements.append(
                f'<joint name="{model.joint(j).name}"'
                f' type="revolute"><parent>{parent}</parent><child>{child}</child>{axis}</joint>'
            )
            parent, pos = child, np.zeros(3)
        if not hinges:
            link(names[b], parent, pos, *body_inertia)
    return (
        '<?xml version="1.0"?><sdf version="1.10"><model'
        f' name="figure">{"".join(elements)}</model></sdf>'
    )


def main(kind: str, name: str, dtype: str, batch: int, steps: int):
    """Compile one library's steps and run them once for every line of the standard input."""
    # on two cores, and sometimes on one, MJX's batches deadlock (mujoco-mjx 3.17.0, jax 0.10.1)
    os.sched_setaffinity(0, {0})
    stdout = os.dup(1)
    os.dup2(2, 1)
    answer = lambda x: os.write(stdout, (json.dumps(x) + "\n").encode())
    jax.config.update("jax_enable_x64", dtype == "float64")
    try:
        program = (
            compile_steps(*mjx_steps(name, batch), steps)
            if kind == "mjx"
            else jaxsim_program(name, batch, steps)
        )
    except ImportError as missing:
        answer({"missing": str(missing)})
        return
    answer({"compile_stats": program.compile_stats})
    for _ in sys.stdin:
        program()
        answer("done")


if __name__ == "__main__":
    main(*sys.argv[1:4], *map(int, sys.argv[4:]))
