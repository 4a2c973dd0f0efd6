"""docs/errors.md: every message of the library is on the page, and every one of them is provoked,
here or where the page's list says."""

import pathlib
import re
from unittest import mock

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import models
import mujoco
import numpy as np
import pytest
import said
from said import PAGE, ROWS

import svkc
from svkc._jax.primitive import operation
from svkc.cli import run as commands

TESTS = pathlib.Path(__file__).parents[1]

# provoked in tests that need more than a call
ELSEWHERE = {
    "rollout: another process": ("tools/test_rollout.py", "another process"),
    "out: ... holds another": ("tools/test_rollout.py", "holds another rollout"),
    "expected NAME@TIME": ("project/test_commands.py", "expected NAME@TIME"),
}


class Setting:
    """What calls are made on."""

    def __init__(self, folder):
        self.folder = folder
        self.four = models.four_bar()
        self.state = self.four.state()
        self.spare = svkc.load(models.MJCF.format(models.FOUR_BAR), spare=1)
        self.empty = self.spare.state()
        self.motor = models.MJCF.format(models.bar("arm", models.Y, "0 0 -1")).replace(
            "</mujoco>", '<actuator><motor joint="arm"/></actuator></mujoco>'
        )

    def simulate(self, chain=None, **kw):
        chain = chain or self.four
        state = kw.pop("state", self.state if chain is self.four else self.empty)
        return svkc.simulate(chain, state, **({"t1": 1.0} | kw))

    def load(self, text=None, **kw):
        return svkc.load(text or models.MJCF.format(models.FOUR_BAR), **kw)

    def file(self, **changed):
        """Loads a run whose file was changed."""
        path = self.folder / "run.npz"
        if not path.exists():
            self.simulate(t1=1e-3, dt=1e-3).save(path)
        with np.load(path) as file:
            arrays = dict(file) | changed
        np.savez(
            self.folder / "changed.npz", **{name: x for name, x in arrays.items() if x is not None}
        )
        return svkc.load_trajectory(self.folder / "changed.npz")

    def bound(self, *args, **kw):
        return svkc.bind(self.spare, self.empty, "spare_0", *args, **kw)


def away(s):
    """A link that is to hold what is elsewhere."""
    chain = s.load(virtual_links=[link(pos=(5, 0, 0), real_pos=(0, 0, 0))])
    return svkc.connect(chain, chain.state(), "x")


def link(**kw):
    return svkc.VirtualLink(**({"name": "x", "parent": "world", "real": "rocker"} | kw))


def endless():
    model = mujoco.MjModel.from_xml_string(models.MJCF.format(models.bar("a", models.Y, "0 0 -1")))
    model.body_mass[1] = np.inf
    return model


def single(s):
    with jax.enable_x64(False):
        s.simulate()


def crowded(s):
    with mock.patch("jax.process_count", return_value=9):
        svkc.rollout(s.four, jax.tree.map(lambda x: x[None], s.state), 1.0)


def too_large(s):
    exhausted = jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory.")
    with mock.patch("svkc.tools.rollout._piece", side_effect=exhausted):
        svkc.rollout(s.four, jax.tree.map(lambda x: x[None], s.state), 1.0)


def undrawn(s):
    traj = s.simulate(t1=1e-3, dt=1e-3)
    with mock.patch.dict(
        "sys.modules", {"mujoco.egl": None, "mujoco.osmesa": None, "mujoco.glfw": None}
    ):
        svkc.render(s.four, traj, s.folder / "x.gif")


def twice(s):
    """Two specs attached with one prefix: two default classes of one name."""
    spec = mujoco.MjSpec()
    for name in ("a", "b"):
        part = mujoco.MjSpec()
        body = part.worldbody.add_body(name=name)
        body.add_joint(name=f"{name}_joint")
        body.add_geom(size=[0.1, 0, 0])
        spec.attach(part, prefix="the_", frame=spec.worldbody.add_frame())
    svkc.load(spec).to_mjcf()


def without_ffmpeg(s):
    with mock.patch.dict("sys.modules", {"imageio_ffmpeg": None}):
        svkc.render(s.four, s.simulate(t1=1e-3, dt=1e-3), s.folder / "x.mp4")


def nameless(s):
    path = s.folder / "nameless.npz"
    s.simulate(t1=1e-3, dt=1e-3).save(path)
    svkc.load_chain(path)


def undrawable(s):
    with mock.patch.dict("sys.modules", {"matplotlib": None}):
        s.simulate(t1=1e-3, dt=1e-3).plot()


CASES = {
    "pictures need": undrawable,
    "... holds no model": nameless,
    "camera: no": lambda s: svkc.render(
        s.four, s.simulate(t1=1e-3, dt=1e-3), s.folder / "x.gif", camera="nobody's"
    ),
    "mp4 needs": without_ffmpeg,
    "run: no scene": lambda s: commands._scene("nowhere", ()),
    "run: no virtual": lambda s: commands._asked(s.four, [("release", "nobody", 0.1)]),
    "trails: no": lambda s: svkc.render(
        s.four, s.simulate(t1=1e-3, dt=1e-3), s.folder / "x.gif", trails=("nobody",)
    ),
    "... is not linear": lambda s: jax.linear_transpose(
        operation("odd", jnp.sin, lambda p, t: (p[0], t[0])), jnp.ones(2)
    )(jnp.ones(2)),
    "no library to draw with": undrawn,
    "state and chain are float64": single,
    "states: ... lanes": crowded,
    "... has schema": lambda s: s.file(metadata=np.array('{"schema": 99}')),
    "... is not a whole trajectory": lambda s: s.file(metadata=None),
    "... lacks": lambda s: s.file(ts=None),
    "...: expected a function": lambda s: s.simulate(control=3),
    "...: expected finite": lambda s: s.four.state([np.nan, 0, 0]),
    "...: expected real": lambda s: s.four.state(["a", "b", "c"]),
    "...: expected names": lambda s: svkc.at(0.5, connect=3),
    "...: got ..., expected True": lambda s: link(connected="no"),
    "...: got ..., expected a whole": lambda s: s.load(spare=1e300),
    "...: got shape ..., expected (...,); for many use": lambda s: svkc.xyzw(s.four, jnp.zeros(9)),
    "...: got ..., expected a positive": lambda s: s.simulate(dt=-1.0),
    "...: got shape ..., expected (...,) for the tree": lambda s: s.four.state(np.zeros(7)),
    "...: got shape ..., expected a number or": lambda s: svkc.actuation(
        s.four, s.state, jnp.zeros(4), bounds=(np.zeros(2), np.ones(2))
    ),
    "...: got shape ..., expected ... numbers": lambda s: svkc.render(
        s.four, s.simulate(t1=1e-3, dt=1e-3), s.folder / "x.gif", lookat=(1, 2)
    ),
    "...: got shape ..., expected one number": lambda s: s.simulate(t1=jnp.ones(2)),
    "...[...]: got": lambda s: s.four.state({"crank": [1.0, 2.0]}),
    "actuated: expected": lambda s: svkc.actuation(
        s.four, s.state, jnp.zeros(4), actuated=np.ones(2, bool)
    ),
    "adjoint: expected": lambda s: s.simulate(adjoint="replay"),
    "adjoint: svkc.Replay": lambda s: s.simulate(
        stepsize_controller=diffrax.StepTo(jnp.linspace(0, 1, 5)), adjoint=svkc.Replay()
    ),
    "at: got time": lambda s: s.simulate(events=[svkc.at(-1.0, cut="pin")]),
    "at: time must": lambda s: s.simulate(events=[svkc.at(jnp.ones(2), cut="pin")]),
    "bind: ... is not": lambda s: svkc.bind(s.four, s.state, "pin", "world", "rocker"),
    "bind: a spare slot has no": lambda s: s.bound("world", "rocker", joint="universal"),
    "bind: axis": lambda s: s.bound("world", "rocker", joint="hinge", axis=(0, 0, 0)),
    "bind: expected": lambda s: svkc.at(0.5, bind="rocker"),
    "bind: no body": lambda s: s.bound("world", "nobody"),
    "bind: ...: expected three": lambda s: s.simulate(
        s.spare, events=[svkc.at(0.5, bind=[svkc.Grip("world", "rocker", real_pos=jnp.zeros(2))])]
    ),
    "bind: the chain": lambda s: s.simulate(
        events=[svkc.at(0.5, bind=[svkc.Grip("world", "rocker")])]
    ),
    "bounds: expected (": lambda s: svkc.actuation(s.four, s.state, jnp.zeros(4), bounds=3),
    "bounds: expected lower": lambda s: svkc.actuation(
        s.four, s.state, jnp.zeros(4), bounds=(1.0, -1.0)
    ),
    "chain: expected": lambda s: svkc.poses(3, s.state),
    "check_grad: f(x) has": lambda s: svkc.check_grad(lambda x: 1, jnp.asarray(1.0)),
    "check_grad: f(x)...": lambda s: svkc.check_grad(lambda x: jnp.log(x), jnp.asarray(-1.0)),
    "check_grad: x has": lambda s: svkc.check_grad(lambda x: x, jnp.asarray(1)),
    "chunk: ... lanes": too_large,
    "connect: the bodies": away,
    "connected: expected": lambda s: s.four.state(connected=np.ones(3)),
    "cost: got": lambda s: svkc.rollout(
        s.four, jax.tree.map(lambda x: x[None], s.state), 1.0, cost=jnp.ones((1, 2))
    ),
    "cuttable: ... belongs": lambda s: s.load(
        models.MJCF.format(
            '<body name="b"><joint name="x" type="slide"/><joint name="y" type="slide"/><geom'
            ' size="0.1"/></body>'
        ),
        cuttable="x",
    ),
    "cuttable: no joint": lambda s: s.load(cuttable="nobody"),
    "data: got": lambda s: svkc.to_mujoco(
        s.four, s.state, type("Data", (), {"qpos": np.zeros(1), "qvel": np.zeros(1)})()
    ),
    "devices: expected": lambda s: svkc.rollout(
        s.four, jax.tree.map(lambda x: x[None], s.state), 1.0, devices=[]
    ),
    "dt: got": lambda s: s.simulate(dt=1e-12),
    "dt asks": lambda s: s.simulate(dt=0.1, rtol=1e-3),
    "dynamics.hold": lambda s: s.simulate(dynamics=svkc.dynamics.CompositeBodies(hold=2.0)),
    "dynamics.inertia": lambda s: s.simulate(dynamics=svkc.Dynamics(inertia=lambda *_: None)),
    "dynamics: expected": lambda s: s.simulate(dynamics=3),
    "events: expected": lambda s: s.simulate(events=["pin"]),
    "here: ...": lambda s: svkc.at(0.5, connect="pin", here="other"),
    "ignore: got": lambda s: s.load(ignore=("nothing",)),
    "joint: got": lambda s: link(joint="screw"),
    "lane: expected a dict": lambda s: svkc.rollout(
        s.four, jax.tree.map(lambda x: x[None], s.state), 1.0, lane=lambda chain, data: 3
    ),
    "load_trajectory: expected": lambda s: svkc.load_trajectory(3),
    "leaves: axis": lambda s: svkc.leaves(s.four, "pin", axis=(0, 0, 0)),
    "mode: got": lambda s: svkc.check_grad(lambda x: x, jnp.asarray(1.0), mode="sideways"),
    "no joint ...": lambda s: s.four.state({"nobody": 1.0}),
    "no joint coordinate": lambda s: svkc.prefer(s.four, s.state, "nobody"),
    "source: no such file": lambda s: s.load("nowhere.xml"),
    "no virtual link": lambda s: svkc.cut(s.four, s.state, "nobody"),
    "overload: give": lambda s: svkc.overload(s.four, "pin"),
    "q: the quaternion": (
        lambda s: s.load(models.MJCF.format(models.bar("b", 'type="ball"', "0 0 1"))).state(
            [1.0, 1.0, 0, 0]
        )
    ),
    "render: a picture": lambda s: svkc.render(
        s.four, jax.tree.map(lambda x: x[None], s.simulate(t1=1e-3, dt=1e-3)), s.folder / "x.html"
    ),
    "render: ... should": lambda s: svkc.render(s.four, s.simulate(t1=1e-3, dt=1e-3), "x.bmp"),
    "rtol and atol": lambda s: s.simulate(
        rtol=1e-3, stepsize_controller=diffrax.PIDController(rtol=1e-3, atol=1e-6)
    ),
    "simulate stopped": lambda s: s.simulate(t1=1e-2, dt=1e-3, max_steps=2),
    "solver: ... does not": lambda s: s.simulate(solver=diffrax.Euler()),
    "solver: expected": lambda s: s.simulate(solver="euler"),
    "source: expected": lambda s: svkc.load(3),
    "source: names of": lambda s: s.load(
        models.MJCF.format(
            models.bar("joint_1", models.Y, "0 0 -1", inside=models.bar("", models.Y, "0 0 -1"))
        )
    ),
    "source: the model has no joints": lambda s: svkc.load("<mujoco/>"),
    "source: the model has numbers": lambda s: svkc.load(endless()),
    "stepsize_controller": lambda s: s.simulate(stepsize_controller=3),
    "progress_meter": lambda s: s.simulate(progress_meter=3),
    "source: the model cannot": lambda s: s.load("<mujoco><nonsense/></mujoco>"),
    "stabilization": lambda s: s.simulate(stabilization=3),
    "state....: got": lambda s: s.simulate(
        state=svkc.State(jnp.zeros(2), s.state.v, s.state.structure)
    ),
    "state.q is": lambda s: s.simulate(
        state=eqx.tree_at(lambda x: (x.q, x.v), s.state, replace_fn=lambda x: x.astype(jnp.float32))
    ),
    "state: expected": lambda s: svkc.poses(s.four, 3),
    "state: q and v": lambda s: s.simulate(
        state=svkc.State(s.state.q * jnp.nan, s.state.v, s.state.structure)
    ),
    "states, data, cost": lambda s: svkc.rollout(
        s.four, jax.tree.map(lambda x: x[None], s.state), 1.0, data=jnp.zeros(3)
    ),
    "states: expected": lambda s: svkc.rollout(s.four, 3, 1.0),
    "t1: got": lambda s: s.simulate(t1=-1.0),
    "target: ... cannot": lambda s: svkc.tune(
        s.four,
        s.state,
        1e-2,
        target=1e-3,
        control=lambda t, x, args: jnp.full(s.four.dofs, jnp.nan),
    ),
    "tau: got": lambda s: svkc.forward_dynamics(s.four, s.state, jnp.zeros(9)),
    "the loops cannot": (
        lambda s: s.load(
            virtual_links=[link(pos=(50, 0, 0), real_pos=(0, 0, 0), connected=True)]
        ).state()
    ),
    "the model has elements": lambda s: s.load(
        s.motor.replace("</worldbody>", '<site name="s"/></worldbody>').replace(
            "<motor", "<position"
        )
    ),
    "to_mjcf: MuJoCo": twice,
    "to_mjcf: the": lambda s: svkc.load(s.four.model.model).to_mjcf(),
    "traj: expected": lambda s: svkc.render(s.four, 3, "x.gif"),
    "touch: axes": lambda s: svkc.touch(s.four, "pin", 0.1, axes="w"),
    "ts: expected": lambda s: s.simulate(ts=jnp.array([0.5, 0.2])),
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
    "virtual_links: names": lambda s: s.load(virtual_links=[link(), link()]),
    "weight: expected": lambda s: svkc.actuation(s.four, s.state, jnp.zeros(4), weight=-np.ones(4)),
    "when: direction": lambda s: svkc.when(lambda t, x, args: t, direction="up"),
    "when: guard": lambda s: svkc.when(3),
}


@pytest.fixture(scope="module")
def setting(tmp_path_factory):
    return Setting(tmp_path_factory.mktemp("errors"))


def _row(opening: str) -> str:
    """The one row that begins so, and with no longer opening of another case."""
    rows = [
        row
        for row in ROWS
        if row.startswith(opening)
        and not any(len(o) > len(opening) and row.startswith(o) for o in (*CASES, *ELSEWHERE))
    ]
    assert len(rows) == 1, (opening, rows)
    return rows[0]


def test_the_page_has_every_message():
    assert sorted(ROWS) == sorted(said.messages())
    assert sorted(map(_row, [*CASES, *ELSEWHERE])) == sorted(ROWS)
    for file, words in ELSEWHERE.values():
        assert words in (TESTS / file).read_text(), file
    codes = [name for name in vars(svkc.RESULTS) if not name.startswith("_")]
    for name in codes:
        assert f"| `{name}` |" in PAGE, name


@pytest.mark.parametrize("opening", CASES)
def test_each_message(setting, opening):
    with (
        said.as_users_see(),
        pytest.raises((ValueError, RuntimeError, NotImplementedError)) as caught,
    ):
        CASES[opening](setting)
    assert re.fullmatch(said.pattern(_row(opening)), " ".join(str(caught.value).split())), (
        caught.value
    )


@pytest.mark.slow
def test_inside_compiled_programs(setting):
    """What cannot be known while tracing is raised by the program."""
    assert sorted(said.COMPILED) == sorted(said.messages_of("error_if", 2))
    apart = setting.load(virtual_links=[link(pos=(5, 0, 0), real_pos=(0, 0, 0))])
    beyond = setting.load(virtual_links=[link(pos=(50, 0, 0), real_pos=(0, 0, 0), connected=True)])
    calls = {
        "connect: the bodies": lambda: jax.jit(lambda s: svkc.connect(apart, s, "x"))(
            apart.state()
        ),
        "the loops of": lambda: jax.jit(lambda q: beyond.state({"crank": q}))(0.1),
        str(svkc.RESULTS[svkc.RESULTS.max_steps]): lambda: jax.jit(
            lambda t: setting.simulate(t1=t, dt=1e-3, max_steps=2).t_final
        )(1e-2),
    }
    for row in said.COMPILED:
        assert any(row.startswith(opening) for opening in calls)
    for opening, call in calls.items():
        with said.as_users_see(), pytest.raises(RuntimeError, match=re.escape(opening)):
            call()


def test_warnings_and_what_others_raise(setting, tmp_path):
    warned, again, missing, unlike = said.OTHERS
    assert said.messages_of("warn", 0) == {warned, again}
    # it takes two compilations: tests/_jax/test_functions.py
    assert "a new function object" in again
    assert "a new function object" in (TESTS / "_jax/test_functions.py").read_text()
    with jax.enable_x64(False):
        chain = models.four_bar()
        with pytest.warns(UserWarning, match=said.pattern(warned)):
            chain.state(v=np.array([1.0, 0.0, 0.0]))
    for read in (svkc.load_trajectory, svkc.load_chain):
        with pytest.raises(FileNotFoundError, match=said.pattern(missing)):
            read(tmp_path / "none.npz")
    lighter = setting.load(models.MJCF.format(models.FOUR_BAR).replace("-9.81", "-1.62"))
    with pytest.raises(ValueError, match=said.pattern(unlike)):
        jax.tree.map(lambda *x: jnp.stack(x), setting.load(), lighter)
