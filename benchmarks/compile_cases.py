"""Programs whose compilation compile.py measures, and public functions that compile when called.

A program is a function without arguments that returns (function, arguments). svkc is imported
inside functions, because compile.py also measures other checkouts of svkc.
"""

# a planar arm of two links, and a ball in flight to its hand: five freedoms
ARM_AND_BALL = """<mujoco><worldbody>
<body name="upper" pos="0 0 1"><joint name="shoulder" axis="0 1 0"/><geom type="capsule"
  fromto="0 0 0 0 0 -0.5" size="0.03"/>
<body name="lower" pos="0 0 -0.5"><joint name="elbow" axis="0 1 0"/><geom type="capsule"
  fromto="0 0 0 0 0 -0.5" size="0.03"/></body></body>
<body name="ball" pos="-0.6 0 0.44"><joint name="x" type="slide" axis="1 0 0"/><joint name="z"
  type="slide" axis="0 0 1"/>
<joint name="turn" axis="0 1 0"/><geom type="sphere" size="0.05"/></body></worldbody></mujoco>"""

FOUR_BAR = """<mujoco><worldbody>
<body name="crank"><joint name="crank" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 0.4"
  size="0.03" contype="0" conaffinity="0"/>
<body name="coupler" pos="0 0 0.4"><joint name="coupler" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 1 0 0.2" size="0.03" contype="0" conaffinity="0"/>
<body name="rocker" pos="1 0 0.2"><joint name="rocker" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0.2 0 -0.6" size="0.03" contype="0" conaffinity="0"/></body>
</body></body></worldbody></mujoco>"""

OPTIONS = {"rtol": 1e-8, "atol": 1e-10, "throw": False}


def _figure():
    from svkc.scenes import high_bar

    return high_bar()


def _four_bar():
    import svkc

    pin = svkc.VirtualLink(
        "pin",
        "world",
        "rocker",
        "hinge",
        pos=(1.2, 0, 0),
        axis=(0, 1, 0),
        real_pos=(0.2, 0, -0.6),
        connected=True,
    )
    chain = svkc.load(FOUR_BAR, virtual_links=[pin])
    return chain, chain.state(v={"crank": 4.0})


def forward_dynamics():
    """Return accelerations of the high bar's figure, both hands on the bar."""
    import jax.numpy as jnp

    import svkc

    chain, state = _figure()
    return (lambda s, tau: svkc.forward_dynamics(chain, s, tau)), (state, jnp.zeros(chain.nv))


def one_phase():
    """Return half a second of the high bar without events."""
    import svkc

    chain, state = _figure()
    return (lambda s: svkc.simulate(chain, s, 0.5, **OPTIONS)), (state,)


def main_job():
    """Return the run of `python -m svkc`: two hands, one hand, flight."""
    import jax.numpy as jnp

    import svkc

    chain, state = _figure()
    events = (svkc.at(0.9, cut="right_hand_grip"), svkc.at(1.15, cut="left_hand_grip"))
    return (
        lambda s: svkc.simulate(
            chain, s, 1.8, ts=jnp.linspace(0, 1.8, 73), events=events, **OPTIONS
        )
    ), (state,)


def _gradient():
    import gradients
    import jax

    loss, p = gradients.high_bar_loss()
    return jax.value_and_grad(loss), p


def gradient():
    """Return the main job's gradient by 198 parameters, which include the release times."""
    derivative, p = _gradient()
    return derivative, (p,)


def gradients_in_lanes():
    """Return the batched gradient of the main job: 64 lanes."""
    import jax
    import jax.numpy as jnp

    derivative, p = _gradient()
    return jax.vmap(derivative), (jax.tree.map(lambda x: jnp.stack([x] * 64), p),)


def four_bar():
    """Return a four-bar linkage whose loop is cut, and closed again at the current pose."""
    import svkc

    chain, state = _four_bar()
    events = (svkc.at(0.2, cut="pin"), svkc.at(0.3, connect="pin", here=True))
    return (lambda s: svkc.simulate(chain, s, 0.5, events=events, **OPTIONS)), (state,)


def _arm_and_ball():
    import jax.numpy as jnp

    import svkc

    hand = svkc.VirtualLink("hand", "lower", "ball", "weld", pos=(0, 0, -0.5))
    chain = svkc.load(ARM_AND_BALL, virtual_links=[hand], ignore=("contact",))
    state = chain.state(v={"x": 2.0})
    events = (
        svkc.when(svkc.touch(chain, "hand", 0.05), connect="hand", here=True, direction=False),
        svkc.at(0.6, cut="hand"),
    )
    end = lambda v: svkc.simulate(
        chain,
        svkc.State(state.q, v, state.structure),
        0.8,
        ts=jnp.linspace(0, 0.8, 17),
        events=events,
        **OPTIONS,
    )
    return end, state.v


def arm_and_ball():
    """Return a two-link arm that catches and releases a ball: five freedoms, a guard, a timed
    release.
    """
    end, v = _arm_and_ball()
    return end, (v,)


def arm_and_ball_gradient():
    """Return the gradient of the ball's final position by the initial velocities."""
    import jax
    import jax.numpy as jnp

    end, v = _arm_and_ball()
    return jax.grad(lambda v: jnp.sum(end(v).final.q[2:4])), (v,)


def _lanes(count: int):
    import diffrax
    import jax
    import jax.numpy as jnp

    import svkc

    chain, state = _figure()
    options = {
        "solver": diffrax.Tsit5(),
        "rtol": 1e-4,
        "atol": 1e-6,
        "dynamics": svkc.dynamics.ArticulatedBodies(),
        "throw": False,
    }

    def one(state, right):
        events = (svkc.at(right, cut="right_hand_grip"), svkc.at(right + 0.2, cut="left_hand_grip"))
        return svkc.simulate(chain, state, 1.8, events=events, **options)

    states = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), state)
    return jax.vmap(one), (states, jnp.linspace(0.3, 0.9, count))


def lanes_8():
    """Return 8 batched runs of the high bar: Tsit5 at rtol 1e-4, articulated bodies, two releases
    each.
    """
    return _lanes(8)


def lanes_512():
    """Return `lanes_8` with 512 runs."""
    return _lanes(512)


def lanes_4096():
    """Return `lanes_8` with 4,096 runs."""
    return _lanes(4096)


CASES = (
    forward_dynamics, one_phase, main_job, gradient, four_bar, arm_and_ball, arm_and_ball_gradient,
    gradients_in_lanes, lanes_8, lanes_512, lanes_4096,
)  # fmt: skip
PROGRAMS = {f.__name__.replace("_", " "): f for f in CASES}


def eager_calls(model: str) -> dict:
    """Return public functions by name, in the order in which to call them first."""
    import jax.numpy as jnp

    import svkc

    results = {}

    def first_state():
        results["chain"], results["state"] = _figure() if model == "high bar" else _four_bar()

    def on_state(function):
        return lambda: function(results["chain"], results["state"])

    def report():
        return svkc.Trajectory.report(results["run"])

    def cut(chain, state):
        results["open"] = svkc.cut(chain, state, chain.link_names[0])
        return results["open"]

    def connect(chain, state):
        return svkc.connect(chain, results["open"], chain.link_names[0], here=True)

    return {
        "state": first_state,
        "energy": on_state(svkc.energy),
        "coordinates": on_state(svkc.coordinates),
        "mobility": on_state(svkc.mobility),
        "actuation": on_state(
            lambda chain, state: svkc.actuation(chain, state, jnp.zeros(chain.dofs))
        ),
        "loop_forces": on_state(
            lambda chain, state: svkc.loop_forces(chain, state, jnp.zeros(chain.nv))
        ),
        "cut": on_state(cut),
        "connect": on_state(connect),
        "simulate": on_state(
            lambda chain, state: results.update(run=svkc.simulate(chain, state, 1e-3, throw=False))
        ),
        "report": report,
    }
