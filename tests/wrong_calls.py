"""Calls that raise, by the message that each raises."""

import threading
from unittest import mock

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import models
import mujoco
import numpy as np
import wrong_optimizations

import svkc
from svkc._jax.primitive import custom_primitive
from svkc.cli import run as commands
from svkc.loops.constrained_dynamics import Dynamics

TIMES = np.linspace(0, 1, 5)
SITE = models.MJCF.format(models.bar("b", models.Y, "0 0 1", inside='<site name="s"/>'))
RANGE = models.MJCF.format(
    models.bar(
        "stopped",
        models.Y + ' range="-10 10"',
        "0 0 1",
        inside=models.bar("free", models.Y, "0 0 1"),
    )
)
FREE = models.MJCF.format(models.bar("base", 'type="free"', "0 0 1"))


class Setting:
    """Chains, states and files on which the calls are made."""

    def __init__(self, folder):
        self.folder = folder
        self.four = models.four_bar()
        self.state = self.four.state()
        self.spare = svkc.load(models.MJCF.format(models.FOUR_BAR), spare=1)
        self.empty = self.spare.state()
        self.motor = models.ARM.replace(
            "</mujoco>", '<actuator><motor joint="arm"/></actuator></mujoco>'
        )
        self.free = svkc.load(FREE)
        self.site = svkc.load(SITE)
        self.rods = svkc.load(models.MJCF.format(models.TWO_RODS))
        self.data = mujoco.MjData(svkc.load(self.motor).model.model)

    def simulate(self, chain=None, **kw):
        chain = chain or self.four
        state = kw.pop("state", self.state if chain is self.four else self.empty)
        return svkc.simulate(chain, state, **({"t1": 1.0} | kw))

    def short(self):
        return self.simulate(t1=1e-3, dt=1e-3)

    def lanes(self, one=None):
        return jax.tree.map(lambda x: x[None], one or self.state)

    def drawn(self, **kw):
        return svkc.render(self.four, self.short(), self.folder / "x.gif", **kw)

    def actuation(self, *args, **kw):
        return svkc.actuation(self.four, self.state, jnp.zeros(4), *args, **kw)

    def rollout(self, **kw):
        return svkc.rollout(self.four, self.lanes(), 1.0, **kw)

    def along(self, q, ts=TIMES, **kw):
        return svkc.inverse_dynamics_along(self.four, ts, q, **kw)

    def load(self, text=None, **kw):
        return svkc.load(text or models.MJCF.format(models.FOUR_BAR), **kw)

    def file(self, **changed):
        """Load a saved run whose file was modified."""
        path = self.folder / "run.npz"
        if not path.exists():
            self.short().save(path)
        with np.load(path) as file:
            arrays = dict(file) | changed
        np.savez(
            self.folder / "changed.npz", **{name: x for name, x in arrays.items() if x is not None}
        )
        return svkc.load_trajectory(self.folder / "changed.npz")

    def gripped(self, *args, **kw):
        grip = svkc.Grip(*args, **kw)
        return self.simulate(self.spare, t1=0.5, events=[svkc.at(0.1, bind=grip)])

    def bound(self, *args, **kw):
        return svkc.bind(self.spare, self.empty, "spare_0", *args, **kw)

    def gripping(self):
        """Return a state whose spare slot is connected."""
        state = svkc.bind(self.spare, self.empty, "spare_0", "world", "rocker", joint="ball")
        return svkc.connect(self.spare, state, "spare_0", here=True)


def connect_elsewhere(s):
    """Connect a virtual link whose bodies are not at its placement."""
    chain = s.load(virtual_links=[link(pos=(5, 0, 0), real_pos=(0, 0, 0))])
    return svkc.connect(chain, chain.state(), "x")


def link(**kw):
    return svkc.VirtualLink(**({"name": "x", "parent": "world", "real": "rocker"} | kw))


def unclosable_loop(s):
    """Return a chain whose loop cannot be closed: the bars are too short."""
    return s.load(virtual_links=[link(pos=(50, 0, 0), real_pos=(0, 0, 0), connected=True)])


def infinite_mass():
    model = mujoco.MjModel.from_xml_string(models.MJCF.format(models.bar("a", models.Y, "0 0 -1")))
    model.body_mass[1] = np.inf
    return model


def simulate_without_x64(s):
    with jax.enable_x64(False):
        s.simulate()


def rollout_with_nine_processes(s):
    with mock.patch("jax.process_count", return_value=9):
        s.rollout()


def rollout_with_a_lock(s):
    lock = threading.Lock()
    s.rollout(out=s.folder / "chunks", control=lambda t, state, args: state.v * lock.locked())


def rollout_out_of_memory(s):
    exhausted = jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory.")
    with mock.patch("svkc.tools.rollout._run_chunk", side_effect=exhausted):
        s.rollout()


def render_without_opengl(s):
    traj = s.short()
    with mock.patch.dict(
        "sys.modules", {"mujoco.egl": None, "mujoco.osmesa": None, "mujoco.glfw": None}
    ):
        svkc.render(s.four, traj, s.folder / "x.gif")


def clashing_prefixes(s):
    """Attach two specs with one prefix, which gives two default classes one name."""
    spec = mujoco.MjSpec()
    for name in ("a", "b"):
        part = mujoco.MjSpec()
        body = part.worldbody.add_body(name=name)
        body.add_joint(name=f"{name}_joint")
        body.add_geom(size=[0.1, 0, 0])
        spec.attach(part, prefix="the_", frame=spec.worldbody.add_frame())
    svkc.load(spec).to_mjcf()


def render_without_ffmpeg(s):
    with mock.patch.dict("sys.modules", {"imageio_ffmpeg": None}):
        svkc.render(s.four, s.short(), s.folder / "x.mp4")


def load_chain_without_model(s):
    path = s.folder / "no_model.npz"
    s.short().save(path)
    svkc.load_chain(path)


def plot_without_matplotlib(s):
    with mock.patch.dict("sys.modules", {"matplotlib": None}):
        s.short().plot()


def batch_of(traj):
    """Return a batch of two equal runs."""
    return jax.tree.map(lambda x: jnp.stack([x, x]), traj)


CASES = {
    "pictures need": plot_without_matplotlib,
    "... holds no model": load_chain_without_model,
    "stepsize_controller: its": lambda s: svkc.accuracy.estimate_error(
        s.four, s.four.state(), 0.1, stepsize_controller=diffrax.ConstantStepSize()
    ),
    "camera: no": lambda s: s.drawn(camera="nobody's"),
    "mp4 needs": render_without_ffmpeg,
    "run: --ignore": lambda s: commands._load_scene("high_bar", ("tendon",)),
    "run: no scene": lambda s: commands._load_scene("nowhere", ()),
    "... is not linear": lambda s: jax.linear_transpose(
        custom_primitive("odd", jnp.sin, lambda p, t: (p[0], t[0])), jnp.ones(2)
    )(jnp.ones(2)),
    "no library to draw with": render_without_opengl,
    "state and chain are float64": simulate_without_x64,
    "states: ... lanes": rollout_with_nine_processes,
    "... has the ...": lambda s: s.file(
        metadata=np.array('{"schema": 6, "result": "exploded", "derivative": "successful"}')
    ),
    "traj[...]: expected": lambda s: batch_of(s.short())[...],
    "traj[...]: no such": lambda s: batch_of(s.short())[2],
    "traj[...]: this is": lambda s: s.short()[0],
    "... has schema": lambda s: s.file(metadata=np.array('{"schema": 99}')),
    "... is not a complete trajectory": lambda s: s.file(metadata=None),
    "... lacks": lambda s: s.file(ts=None),
    "...: expected a function": lambda s: s.simulate(control=3),
    "...: expected finite": lambda s: s.four.state([np.nan, 0, 0]),
    "...: expected real": lambda s: s.four.state(["a", "b", "c"]),
    "...: expected names": lambda s: svkc.at(0.5, connect=3),
    "...: got ..., with which": lambda s: s.simulate(dt=1e-12),
    "...: got ..., expected True": lambda s: link(connected="no"),
    "...: got ..., expected a whole": lambda s: s.load(spare=1e300),
    "...: got shape ..., expected (...,); use vmap for": lambda s: svkc.interop.quaternions_xyzw(
        s.four, jnp.zeros(9)
    ),
    "...: got ..., expected a positive": lambda s: s.simulate(dt=-1.0),
    "...: got shape ..., expected ... for the tree": lambda s: s.four.state(np.zeros(7)),
    "...: got shape ..., expected a number or": lambda s: s.actuation(
        bounds=(np.zeros(2), np.ones(2))
    ),
    "...: got shape ..., expected ... numbers": lambda s: s.drawn(lookat=(1, 2)),
    "...: got shape ..., expected one number": lambda s: s.simulate(t1=jnp.ones(2)),
    "... and ... both": lambda s: svkc.at(0.1, connect="pin", cut="pin"),
    "...: the loops do not": lambda s: s.four.state({"crank": 0.3, "rocker": 1.0}),
    "...[...]: got": lambda s: s.four.state({"crank": [1.0, 2.0]}),
    "actuated: expected": lambda s: s.actuation(actuated=np.ones(2, bool)),
    "adjoint: expected": lambda s: s.simulate(adjoint="replay"),
    "adjoint: diffrax": lambda s: s.simulate(adjoint=diffrax.BacksolveAdjoint()),
    "adjoint: svkc.integrators.Replay cannot": lambda s: jax.grad(
        lambda t1: jnp.sum(
            s.simulate(t1=t1, solver=diffrax.ReversibleHeun(), dt=0.5, max_steps=2).final.q
        )
    )(1.0),
    "adjoint: svkc.integrators.Replay needs": lambda s: s.simulate(
        stepsize_controller=diffrax.StepTo(jnp.linspace(0, 1, 5)), adjoint=svkc.integrators.Replay()
    ),
    "at: got time": lambda s: s.simulate(events=[svkc.at(-1.0, cut="pin")]),
    "at: got time ..., expected": lambda s: s.simulate(events=[svkc.at(np.nan, cut="pin")]),
    "at: time must": lambda s: s.simulate(events=[svkc.at(jnp.ones(2), cut="pin")]),
    "bind: ... is connected": lambda s: svkc.bind(
        s.spare, s.gripping(), "spare_0", "world", "crank"
    ),
    "bind: ... is not": lambda s: svkc.bind(s.four, s.state, "pin", "world", "rocker"),
    "bind: a spare slot has no": lambda s: s.bound("world", "rocker", joint="universal"),
    "bind: axis": lambda s: s.bound("world", "rocker", joint="hinge", axis=(0, 0, 0)),
    "bind: expected": lambda s: svkc.at(0.5, bind="rocker"),
    "bind: ...: expected three": lambda s: s.simulate(
        s.spare, events=[svkc.at(0.5, bind=[svkc.Grip("world", "rocker", real_pos=jnp.zeros(2))])]
    ),
    "bind: the chain": lambda s: s.simulate(
        events=[svkc.at(0.5, bind=[svkc.Grip("world", "rocker")])]
    ),
    "bounds: expected (": lambda s: s.actuation(bounds=3),
    "bounds: expected lower": lambda s: s.actuation(bounds=(1.0, -1.0)),
    "center_of_mass: the bodies": lambda s: svkc.center_of_mass(s.four, s.state, "world"),
    "chain: expected": lambda s: svkc.poses(3, s.state),
    "chain....: got": lambda s: svkc.poses(
        eqx.tree_at(lambda c: c.mass, s.four, -s.four.mass), s.state
    ),
    "chain.armature": lambda s: svkc.poses(
        eqx.tree_at(lambda c: c.armature, s.four, -jnp.ones(3), is_leaf=lambda x: x is None),
        s.state,
    ),
    "check_grad: f(x) has": lambda s: svkc.check_grad(lambda x: 1, jnp.asarray(1.0)),
    "check_grad: f(x)...": lambda s: svkc.check_grad(lambda x: jnp.log(x), jnp.asarray(-1.0)),
    "check_grad: x has": lambda s: svkc.check_grad(lambda x: x, jnp.asarray(1)),
    "chunk=... lanes": rollout_out_of_memory,
    "connect: spare": lambda s: svkc.connect(s.spare, s.empty, "spare_0", here=True),
    "connect: the bodies": connect_elsewhere,
    "connected: expected": lambda s: s.four.state(connected=np.ones(3)),
    "control: expected control": lambda s: s.simulate(control=lambda t, x, args: None),
    "cost: got": lambda s: s.rollout(cost=jnp.ones((1, 2))),
    "cuttable: ... belongs": lambda s: s.load(
        models.MJCF.format(
            '<body name="b"><joint name="x" type="slide"/><joint name="y" type="slide"/><geom'
            ' size="0.1"/></body>'
        ),
        cuttable="x",
    ),
    "cuttable: got armature": lambda s: s.load(
        models.MJCF.format(models.bar("arm", 'type="hinge" armature="0.1"', "0 0 -1")),
        cuttable="arm",
    ),
    "data: got": lambda s: svkc.interop.to_mujoco(
        s.four, s.state, type("Data", (), {"qpos": np.zeros(1), "qvel": np.zeros(1)})()
    ),
    "devices: expected": lambda s: s.rollout(devices=[]),
    "dt sets": lambda s: s.simulate(dt=0.1, rtol=1e-3),
    "dynamics.hold": lambda s: s.simulate(dynamics=svkc.dynamics.CompositeBodies(hold=2.0)),
    "dynamics.inertia": lambda s: s.simulate(dynamics=Dynamics(inertia=lambda *_: None)),
    "dynamics: expected": lambda s: s.simulate(dynamics=3),
    "events[...]: expected": lambda s: s.simulate(events=[svkc.when(lambda t, x, args: t > 0)]),
    "events: expected": lambda s: s.simulate(events=["pin"]),
    "here: ...": lambda s: svkc.at(0.5, connect="pin", here="other"),
    "ignore: got": lambda s: s.load(ignore=("nothing",)),
    "inverse_dynamics_along: at t = ... s the joints": lambda s: s.along({}),
    "inverse_dynamics_along: at t = ... s:": lambda s: s.along({"crank": TIMES, "rocker": TIMES}),
    "q[...]: got shape": lambda s: s.along({"crank": TIMES[:2]}),
    "joint: got": lambda s: link(joint="screw"),
    "lane: expected a dict": lambda s: s.rollout(lane=lambda chain, data: 3),
    "...: expected a path": lambda s: svkc.load_trajectory(3),
    "leaves: axis": lambda s: svkc.leaves(s.four, "pin", axis=(0, 0, 0)),
    "mode: got": lambda s: svkc.check_grad(lambda x: x, jnp.asarray(1.0), mode="sideways"),
    "after: expected": lambda s: svkc.at(0.1, cut="pin", after=0.2),
    "after: the event": lambda s: s.simulate(
        events=svkc.at(0.1, cut="pin", after=svkc.at(0.1, stop=True))
    ),
    "at: got time ... after": lambda s: s.simulate(
        events=[first := svkc.at(0.1, cut="pin"), svkc.at(-0.1, stop=True, after=first)]
    ),
    "...: ... is a cuttable": lambda s: s.load(cuttable="rocker").replace(
        axis={"rocker": [0, 0, 1]}
    ),
    "...: got names": lambda s: s.four.replace(gravity={"crank": 1.0}),
    "limit: ... has": lambda s: svkc.load(RANGE).replace(limit={"free": [0, 1]}),
    "...: body": lambda s: s.free.replace(pos={"base": [0, 0, 1]}),
    "limit: the model": lambda s: s.four.replace(limit={"crank": [0, 1]}),
    "scale_inertia: body": lambda s: s.four.replace(mass={"world": 1.0}, scale_inertia=True),
    "scale_inertia: give": lambda s: s.four.replace(scale_inertia=True),
    "...: got an array": lambda s: s.four.replace(gravity=[0, 0]),
    "tau[...]: got": lambda s: s.four.torques({"crank": [1.0, 2.0]}),
    "no ... ...;": lambda s: s.four.state({"nobody": 1.0}),
    "source: no such file": lambda s: s.load("nowhere.xml"),
    "no joint ...; it": lambda s: s.four.state({"pin": 0.1}),
    "no virtual link ..., but": lambda s: svkc.cut(s.four, s.state, "crank"),
    "out: ... cannot": rollout_with_a_lock,
    "overload: give": lambda s: svkc.overload(s.four, "pin"),
    "q: the quaternion": (
        lambda s: s.load(models.MJCF.format(models.bar("b", 'type="ball"', "0 0 1"))).state(
            [1.0, 1.0, 0, 0]
        )
    ),
    "render: a picture": lambda s: svkc.render(s.four, s.lanes(s.short()), s.folder / "x.html"),
    "render: ... should": lambda s: svkc.render(s.four, s.short(), "x.bmp"),
    "rtol, atol and dtmax": lambda s: s.simulate(
        rtol=1e-3, stepsize_controller=diffrax.PIDController(rtol=1e-3, atol=1e-6)
    ),
    "simulate stopped": lambda s: s.simulate(t1=1e-2, dt=1e-3, max_steps=2),
    "solver: ... has no error": lambda s: s.simulate(solver=diffrax.Euler()),
    "solver: ... needs a split": lambda s: s.simulate(dt=0.01, solver=diffrax.SemiImplicitEuler()),
    "solver: expected": lambda s: s.simulate(solver="euler"),
    "source: expected": lambda s: svkc.load(3),
    "source: names of": lambda s: s.load(
        models.MJCF.format(
            models.bar("joint_1", models.Y, "0 0 -1", inside=models.bar("", models.Y, "0 0 -1"))
        )
    ),
    "source: the model has no joints": lambda s: svkc.load("<mujoco/>"),
    "source: the model has numbers": lambda s: svkc.load(infinite_mass()),
    "...: expected a diffrax object": lambda s: s.simulate(stepsize_controller=3),
    "source: the model cannot": lambda s: s.load("<mujoco><nonsense/></mujoco>"),
    "stabilization": lambda s: s.simulate(stabilization=3),
    "state....: got": lambda s: s.simulate(
        state=svkc.State(jnp.zeros(2), s.state.v, s.state.structure)
    ),
    "state.... is": lambda s: s.simulate(
        state=eqx.tree_at(lambda x: (x.q, x.v), s.state, replace_fn=lambda x: x.astype(jnp.float32))
    ),
    "state: expected": lambda s: svkc.poses(s.four, 3),
    "state: q and v": lambda s: s.simulate(
        state=svkc.State(s.state.q * jnp.nan, s.state.v, s.state.structure)
    ),
    "states, data, cost": lambda s: s.rollout(data=jnp.zeros(3)),
    "states: expected": lambda s: svkc.rollout(s.four, 3, 1.0),
    "t1: got": lambda s: s.simulate(t1=-1.0),
    "target: ... cannot": lambda s: svkc.accuracy.tune(
        s.four,
        s.state,
        1e-2,
        target=1e-3,
        control=lambda t, x, args: jnp.full(s.four.dofs, jnp.nan),
    ),
    "tau: got": lambda s: svkc.forward_dynamics(s.four, s.state, jnp.zeros(9)),
    "the loops cannot": lambda s: unclosable_loop(s).state(),
    "the model has elements": lambda s: s.load(
        s.motor.replace("</worldbody>", '<site name="s"/></worldbody>').replace(
            "<motor", "<position"
        )
    ),
    "to_mjcf: MuJoCo": clashing_prefixes,
    "to_mjcf: the": lambda s: svkc.load(s.four.model.model).to_mjcf(),
    "traj: expected": lambda s: svkc.render(s.four, 3, "x.gif"),
    "touch: axes": lambda s: svkc.touch(s.four, "pin", 0.1, axes="w"),
    "ts: expected at least": lambda s: s.along({"crank": TIMES}, ts=TIMES[::-1]),
    "ts: expected one": lambda s: s.simulate(ts=0.5),
    "ts: expected non": lambda s: s.simulate(ts=jnp.array([0.5, 0.2])),
    "u: got": lambda s: s.load(s.motor).motors(jnp.zeros(3)),
    "unbind: expected": lambda s: svkc.at(0.5, unbind=3),
    "vdot: got": lambda s: svkc.inverse_dynamics(s.four, s.state, jnp.zeros(9)),
    "vdot_G: got": lambda s: svkc.actuation(s.four, s.state, jnp.zeros(9)),
    "virtual link: ...": lambda s: link(name=3),
    "virtual link ...: ... is": lambda s: s.load(virtual_links=[link(parent="nobody")]),
    "virtual link ...: ... must be ... finite": lambda s: link(pos=(1, 2)),
    "virtual link ...: ... must be a unit": lambda s: link(quat=(1, 1, 0, 0)),
    "virtual link ...: axis": lambda s: link(axis=(0, 0, 0)),
    "virtual_links: expected": lambda s: s.load(virtual_links=["pin"]),
    "v: ... is locked": lambda s: s.rods.state(
        v={"upper": 1.0}, near=svkc.lock(s.rods, s.rods.state(), "upper")
    ),
    "virtual_links: names": lambda s: s.load(virtual_links=[link(), link()]),
    "weight: expected": lambda s: s.actuation(weight=-np.ones(4)),
    "when: direction": lambda s: svkc.when(lambda t, x, args: t, direction="up"),
    **wrong_optimizations.CASES,
}

# other ways to some of the messages, by words of those
ALSO = [
    ("libegl1 libgl1", render_without_opengl),
    # runs
    ("ts", lambda s: s.simulate(ts=[0.0, 2.0])),
    ("ts: .* shape .0,.", lambda s: s.simulate(ts=[])),
    (
        "ts: .* shape .2, 2.",
        lambda s: jax.jit(lambda t1: s.simulate(t1=t1, ts=np.zeros((2, 2))).ts)(1.0),
    ),
    (
        "Replay needs .* without jump_ts",
        lambda s: s.simulate(
            stepsize_controller=diffrax.ClipStepSizeController(
                diffrax.PIDController(1e-6, 1e-8), jump_ts=jnp.array([0.5])
            ),
            adjoint=svkc.integrators.Replay(),
        ),
    ),
    ("rtol", lambda s: s.simulate(rtol=0.0)),
    ("max_events", lambda s: s.simulate(max_events=-1)),
    ("max_steps", lambda s: s.simulate(max_steps=0)),
    ("dtmax: got", lambda s: s.simulate(dtmax=0.0)),
    ("dtmax: expected finite", lambda s: s.simulate(dtmax=np.inf)),
    ("dtmax and stepsize_controller", lambda s: s.simulate(dt=0.1, dtmax=0.2)),
    ("max_step: got", lambda s: svkc.when(lambda t, x, args: t, max_step=-1.0)),
    ("max_step: expected finite", lambda s: svkc.when(lambda t, x, args: t, max_step=np.inf)),
    ("hoook", lambda s: s.simulate(events=[svkc.at(0.5, cut="hoook")])),
    *(
        (
            rf"control\(t, state, args\) to return 4 joint torques.*or 3, the tree's.*, got {got}",
            lambda s, value=value: s.simulate(control=lambda t, x, args: value),
        )
        for value, got in (
            (np.zeros(5), r"float64 of shape \(5,\)"),
            (0.0, r"float64 of shape \(\)"),
            (np.zeros(4, bool), r"bool of shape \(4,\)"),
            (np.zeros(4, complex), r"complex128 of shape \(4,\)"),
            (None, "None"),
            ([0.0, [1.0]], "a list"),
        )
    ),
    *(
        (
            rf"events\[1\]: .* guard\(t, state, args\) to return one floating.*, got {got}",
            lambda s, value=value: s.simulate(
                events=[svkc.at(0.5), svkc.when(lambda t, x, args: value)]
            ),
        )
        for value, got in (
            (np.zeros(1), r"float64 of shape \(1,\)"),
            (1, r"int64 of shape \(\)"),
            (True, r"bool of shape \(\)"),
            (1j, r"complex128 of shape \(\)"),
            (None, "None"),
            ([1.0], r"float64 of shape \(1,\)"),
        )
    ),
    (
        r"control: expected a function of \(t, state, args\), got one of \(t, x\)",
        lambda s: s.simulate(control=lambda t, x: x.v),
    ),
    (
        r"control: expected a function of \(t, state, args\), got one of \(t, x\)",
        lambda s: s.rollout(control=lambda t, x: x.v),
    ),
    (
        r"when: guard: expected a function of \(t, state, args\), got one of \(t, x, args, more\)",
        lambda s: svkc.when(lambda t, x, args, more: t),
    ),
    (
        r"lane: expected a function of \(chain, data\), got one of \(chain\)",
        lambda s: s.rollout(lane=lambda chain: {}),
    ),
    (
        "f: expected a function of .x., got one of .x, y.",
        lambda s: svkc.check_grad(lambda x, y: x, 1.0),
    ),
    (
        r"no virtual link 'crank', but a joint of the tree.*cuttable='crank'",
        lambda s: s.simulate(events=[svkc.at(0.5, cut="crank")]),
    ),
    ("expected 4 joint torques", lambda s: svkc.step(s.four, s.state, jnp.zeros(2), 1e-3)),
    (
        "implicit_damping: got 'no'",
        lambda s: svkc.step(s.four, s.state, jnp.zeros(3), 1e-3, implicit_damping="no"),
    ),
    ("here", lambda s: svkc.at(1.0, here="a")),
    ("when: guard: expected a function of .*, got 3", lambda s: svkc.when(3)),
    ("target: got 0", lambda s: svkc.accuracy.tune(s.four, s.state, 0.5, target=0.0)),
    (
        "expected an object of svkc.dynamics",
        lambda s: s.simulate(dynamics=svkc.stabilization.Projection()),
    ),
    (
        "expected an object of svkc.dynamics",
        lambda s: s.simulate(dynamics=svkc.dynamics.UnitVectors),
    ),
    (
        "dynamics.hold: got 2.0",
        lambda s: s.simulate(dynamics=svkc.dynamics.ArticulatedBodies(hold=2.0)),
    ),
    (
        "dynamics.hold: got 2.0",
        lambda s: s.simulate(dynamics=svkc.dynamics.CompositeBodies(hold=2.0)),
    ),
    (
        "dynamics.inertia: got",
        lambda s: s.simulate(dynamics=Dynamics(inertia=svkc.mass_matrix)),
    ),
    ("one leading axis of lanes", lambda s: svkc.rollout(s.four, s.state, 1.0)),
    ("check_grad: x has", lambda s: svkc.check_grad(jnp.sin, 3)),
    # verbs
    ("weight.*positive", lambda s: s.actuation(np.zeros(4))),
    ("weight.*shape", lambda s: s.actuation(np.ones(2))),
    ("nobody.*virtual links: pin", lambda s: svkc.connect(s.four, s.state, "nobody")),
    ("Booleans", lambda s: svkc.transition(s.four, s.state, np.array([1]))),
    ("neck", lambda s: svkc.lock(s.four, s.state, "neck")),
    ("expected 4 joint torques", lambda s: svkc.forward_dynamics(s.four, s.state, jnp.zeros(2))),
    (
        "got 1 qpos and 1 qvel.* has 3 and 3",
        lambda s: svkc.interop.to_mujoco(s.four, s.state, s.data),
    ),
    ("got 1 qpos and 1 qvel.* has 3 and 3", lambda s: svkc.interop.from_mujoco(s.four, s.data)),
    ("no virtual link 'pins'", lambda s: svkc.touch(s.four, "pins")),
    ("axes", lambda s: svkc.touch(s.four, "pin", axes="xx")),
    # points of bodies
    (
        "no body 'rockr'; did you mean 'rocker'. bodies: world, crank",
        lambda s: svkc.apply_force(s.four, s.state, "rockr", jnp.zeros(3)),
    ),
    (
        "no body or site 3; bodies or sites: world, b, s",
        lambda s: svkc.point_velocity(s.site, s.site.state(), 3),
    ),
    ("no body 's'; bodies: world, b", lambda s: svkc.center_of_mass(s.site, s.site.state(), "s")),
    ("bodies: expected names, got 3", lambda s: svkc.center_of_mass(s.four, s.state, 3)),
    ("the bodies have no mass: none", lambda s: svkc.center_of_mass(s.four, s.state, ())),
    (
        r"point: got shape \(2,\), expected \(3,\)",
        lambda s: svkc.jacobian(s.four, s.state, "crank", (1, 2)),
    ),
    (r"force: expected real", lambda s: svkc.apply_force(s.four, s.state, "crank", "up")),
    # paths
    ("q: got shape .5, 2., expected .5, 3. for the tree", lambda s: s.along(np.ones((5, 2)))),
    ("q: got shape .3,., expected .5, 3. for the tree", lambda s: s.along(np.zeros(3))),
    ("q.'crank'.: got 2 numbers, the joint has 1", lambda s: s.along({"crank": np.ones((5, 2))})),
    ("q.'crank'.: expected finite", lambda s: s.along({"crank": np.full(5, np.inf)})),
    ("no joint 'nose'", lambda s: s.along({"nose": TIMES})),
    (
        "at t = 0.25 s: q: the loops do not allow.*rocker by",
        lambda s: s.along({"crank": TIMES, "rocker": TIMES}),
    ),
    ("ts: expected at least four", lambda s: s.along({}, ts=TIMES[:3])),
    ("weight: expected positive", lambda s: s.along({"crank": TIMES}, weight=-1.0)),
    ("no virtual link 'pins'", lambda s: s.along({"crank": TIMES}, connected="pins")),
    (
        "norm 2",
        lambda s: svkc.inverse_dynamics_along(
            s.free, TIMES, {"base": np.tile([0, 0, 0, 2.0, 0, 0, 0], (5, 1))}
        ),
    ),
    (
        "no joint 'nose'. joints: base.x",
        lambda s: svkc.inverse_dynamics_along(s.free, TIMES, {}).torque("nose"),
    ),
    (
        "no virtual link 'pin'. virtual links: none",
        lambda s: svkc.inverse_dynamics_along(s.free, TIMES, {}).wrench("pin"),
    ),
    # states
    ("got 3 numbers, the joint has 7", lambda s: s.free.state(q={"base": np.zeros(3)})),
    ("norm 2", lambda s: s.free.state(q={"base": [0, 0, 0, 2, 0, 0, 0]})),
    ("finite", lambda s: s.four.state(v=np.full(3, np.nan))),
    ("real numbers", lambda s: s.four.state(v=["x"] * 3)),
    ("foot", lambda s: s.four.state({"crank": 0.1}, connected="foot")),
    # how far two bars reach
    (r"cannot be closed.*x by \d+\.\d+ m and", lambda s: unclosable_loop(s).state()),
    (
        r"state\.v is float32",
        lambda s: svkc.poses(
            s.four, eqx.tree_at(lambda x: x.v, s.state, jnp.zeros(4, jnp.float32))
        ),
    ),
    (
        r"state\.structure\.connected: got shape \(2,\), expected \(1,\)",
        lambda s: svkc.poses(
            s.four,
            eqx.tree_at(lambda x: x.structure.connected, s.state, jnp.zeros(2, bool)),
        ),
    ),
    # grips in a run
    ("no body 'nose'", lambda s: s.gripped("crank", "nose")),
    ("no coordinates for 'universal'", lambda s: s.gripped("crank", "rocker", joint="universal")),
    ("axis", lambda s: s.gripped("crank", "rocker", joint="hinge", axis=(0, 0, 0))),
    ("no virtual link 'x'", lambda s: s.gripped("crank", "rocker", slot="x")),
    # models
    ("cannot be read", lambda s: s.load("<mujoco><worldbody><bod/></worldbody></mujoco>")),
    ("no such file", lambda s: s.load("/no/such/file.xml")),
    ("'leg', neither a body nor a site", lambda s: s.load(virtual_links=[link(real="leg")])),
    ("neither a body nor a site", lambda s: s.load(virtual_links=[link(parent="\ud800")])),
    ("whole number", lambda s: s.load(spare=[[1.0], [1.0, 2.0]])),
    ("'base' belongs to body 'base'", lambda s: s.load(FREE, cuttable="base")),
    ("no joint 'nose'; joints: crank", lambda s: s.load(cuttable="nose")),
    ("no joint 'nose'", lambda s: s.load(ignore_armature="nose")),
    (
        "no virtual link 'nobody'",
        lambda s: commands._requested_events(s.four, [("release", "nobody", 0.1)]),
    ),
    ("no virtual link 'nobody'", lambda s: svkc.cut(s.four, s.state, "nobody")),
    ("no body 'nobody'", lambda s: s.bound("world", "nobody")),
    ("no joint coordinate 'x'", lambda s: svkc.with_independent(s.four, s.state, "x")),
    (r"no joint 'cranc'; did you mean 'crank'\?", lambda s: s.four.q_index("cranc")),
    (r"no joint 'cranc'; did you mean 'crank'\?", lambda s: s.four.v_index("cranc")),
    (r"no body 'cranc'; did you mean 'crank'\?", lambda s: s.four.body_index("cranc")),
    ("no body 'nobody'", lambda s: s.four.replace(mass={"nobody": 1.0})),
    (r"axis\['crank'\]: expected finite", lambda s: s.four.replace(axis={"crank": [0, 0, 0]})),
    (r"no parameter 'masses'; did you mean 'mass'\?", lambda s: s.four.replace(masses=1.0)),
    ("no joint 'nobody'", lambda s: svkc.forward_dynamics(s.four, s.state, {"nobody": 1.0})),
    ("no joint 'nobody'", lambda s: s.simulate(control=lambda t, state, args: {"nobody": 1.0})),
    (
        r"mass\['crank'\]: got an array of shape \(2,\)",
        lambda s: s.four.replace(mass={"crank": [1, 2]}),
    ),
    ("scale_inertia: got 1", lambda s: s.four.replace(mass={"crank": 1.0}, scale_inertia=1)),
    ("chin", lambda s: s.load(cuttable=["rocker", "chin"])),
    *wrong_optimizations.ALSO,
]
