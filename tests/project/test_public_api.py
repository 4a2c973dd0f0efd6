"""The public names, and what importing them costs."""

import types

from processes import run

import svkc


def test_importing_loads_nothing_heavy():
    code = (
        "import sys, jax; before = dict(jax.config.values); import svkc; import jax._src.xla_bridge"
        " as b;assert 'mujoco' not in sys.modules and 'matplotlib' not in sys.modules,"
        " 'heavy';assert {k: jax.config.values[k] for k in before} == before, 'settings'; assert"
        " not b._backends, 'backend'"
    )
    done = run("-W", "error", "-c", code)
    assert done.returncode == 0, done.stderr


def test_every_public_name_says_what_it_is():
    for name in dir(svkc):
        thing = getattr(svkc, name)
        if name.startswith("_") or type(thing).__name__ == "module":
            continue
        assert thing.__doc__, name


NAMES = """
Baumgarte Chain Check Drift Dynamics Exact Grip Projection RESULTS Replay RodriguesEuler
SemiImplicitEuler State Structure Trajectory VirtualLink actuation at bias_force bind by_bodies
check_grad connect coordinates cut difference energy error_between forward_dynamics from_mujoco
halved inertia_by_composites inertia_by_unit_vectors integrate inverse_dynamics jacobian
kinetic_energy leaves load load_chain load_trajectory lock loop_forces loop_gaps mass_matrix
mobility momentum overload plot poses potential_energy prefer render rollout simulate step tangent
to_mujoco touch transition tune unbind unlock velocities velocity_gaps when xyzw
"""


def test_the_public_names_are_those_listed():
    names = [
        name
        for name in dir(svkc)
        if not name.startswith("_") and not isinstance(getattr(svkc, name), types.ModuleType)
    ]
    assert sorted(names) == sorted(NAMES.split())


def test_old_names_of_stabilizations():
    assert svkc.Exact is svkc.stabilization.CoordinatePartitioning
    assert svkc.Drift is svkc.stabilization.NoStabilization
