"""Elements of a MuJoCo model that svkc does not simulate, reported all at once."""

from collections.abc import Sequence

import numpy as np

from svkc.mjcf.flags import disabled_actuators, is_disabled
from svkc.model.annotations import MuJoCo


def is_torque_motor(model: MuJoCo) -> np.ndarray:
    """Return the mask [nu] of actuators that are a torque on a joint, gear times control."""
    import mujoco

    joint = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
    inparent = (model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)) & np.array(
        [
            model.jnt_type[j] in (2, 3) if 0 <= j < model.njnt else False
            for j in model.actuator_trnid[:, 0]
        ],
        bool,
    )
    plain = joint | inparent
    plain &= model.actuator_dyntype == int(mujoco.mjtDyn.mjDYN_NONE)
    plain &= (model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_FIXED)) & (
        model.actuator_delay == 0
    )
    return plain & (model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_NONE))


# in the order in which they are reported
UNSUPPORTED_KINDS = (
    "tendon actuator equality friction contact gravcomp fluid polynomial plastic actuatorforce"
    " actuatorgravcomp actuatordamping balllimit flex mocap plugin".split()
)


def _any_nonzero(model, *names: str) -> bool:
    """Return whether one of these arrays of the model has a nonzero entry.

    Arrays that the installed MuJoCo lacks do not count.
    """
    return any(np.any(getattr(model, name, 0)) for name in names)


def _unsupported_in_actuators(model) -> dict[str, tuple]:
    """Return kind -> (whether the model has it, its description) for tendons and actuators."""
    import mujoco

    tendon = [
        n
        for n in ("stiffness", "damping", "limited", "frictionloss", "armature")
        if _any_nonzero(model, f"tendon_{n}", f"tendon_{n}poly")
    ]
    acts = ~disabled_actuators(model)
    pulled = np.any(acts & (model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_TENDON)))
    complex_motors = np.sum(acts & ~is_torque_motor(model))
    return {
        "tendon": (
            tendon or pulled,
            f"{model.ntendon} tendons with {', '.join(tendon) or 'actuators'}",
        ),
        "actuator": (
            complex_motors,
            f"{complex_motors} actuators that are not a torque on a joint (motor with gear)",
        ),
        "actuatordamping": (
            _any_nonzero(model, "actuator_damping", "actuator_armature"),
            "damping or armature of actuators",
        ),
    }


def _unsupported_in_joints(model) -> dict[str, tuple]:
    """Return kind -> (whether the model has it, its description) for joints."""
    import mujoco

    ball = model.jnt_type == int(mujoco.mjtJoint.mjJNT_BALL)
    limited = not is_disabled(model, "limit", "constraint")
    balls = limited * np.sum(ball & (model.jnt_limited != 0))
    rubs = not is_disabled(model, "frictionloss", "constraint")
    return {
        "friction": (rubs and _any_nonzero(model, "dof_frictionloss"), "joint friction loss"),
        "polynomial": (
            _any_nonzero(model, "jnt_stiffnesspoly", "dof_dampingpoly"),
            "polynomial stiffness or damping of joints",
        ),
        "plastic": (_any_nonzero(model, "nplastic"), "plastic joint springs"),
        "actuatorforce": (
            model.nu and _any_nonzero(model, "jnt_actfrclimited"),
            "joint limits on actuator force",
        ),
        "actuatorgravcomp": (
            _any_nonzero(model, "jnt_actgravcomp"),
            "gravity compensation by actuators",
        ),
        "balllimit": (balls, f"{balls} ball joints with a range"),
    }


def _unsupported_in_bodies(model) -> dict[str, tuple]:
    """Return kind -> (whether the model has it, its description) for bodies, constraints between
    bodies, and the fluid around them."""
    import mujoco

    supported = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))
    kinds = () if is_disabled(model, "equality", "constraint") else model.eq_type
    other = [mujoco.mjtEq(int(t)).name[5:].lower() for t in kinds if int(t) not in supported]
    pairs = 0 if is_disabled(model, "contact", "constraint") else model.npair
    density, viscosity, flexes = model.opt.density, model.opt.viscosity, getattr(model, "nflex", 0)
    return {
        "equality": (
            other,
            f"equality constraints: {', '.join(other)} (connect and weld are supported)",
        ),
        "contact": (pairs, f"{pairs} explicit contact pairs"),
        "gravcomp": (_any_nonzero(model, "body_gravcomp"), "gravity compensation"),
        "fluid": (
            density != 0 or viscosity != 0,
            f"fluid forces (density {density:g}, viscosity {viscosity:g})",
        ),
        "flex": (flexes, f"{flexes} deformable (flex) bodies"),
        "mocap": (model.nmocap, f"{model.nmocap} mocap bodies"),
        "plugin": (model.nplugin, f"{model.nplugin} plugins"),
    }


def _unsupported_elements(model) -> list[tuple[str, str]]:
    """Return (kind, description) of every element that changes the motion and is not simulated."""
    elements = (
        _unsupported_in_actuators(model)
        | _unsupported_in_joints(model)
        | _unsupported_in_bodies(model)
    )
    return [(kind, elements[kind][1]) for kind in UNSUPPORTED_KINDS if elements[kind][0]]


class UnsupportedElements(ValueError):
    """The error of a model with elements that are not simulated.

    kinds: their kinds, for `ignore`, with those that were ignored.
    """

    def __init__(self, message: str, kinds: list[str]):
        super().__init__(message)
        self.kinds: tuple[str, ...] = tuple(kinds)


def left_out_elements(model: MuJoCo, ignore: Sequence[str]) -> tuple[str, ...]:
    """Return one line for each kind of element of the model that svkc cannot simulate.

    Raises ValueError, which lists every kind that is neither simulated nor ignored.
    """
    known = {"all", "limit", "spring", "damping", "armature", "collision", *UNSUPPORTED_KINDS}
    unknown = [name for name in ignore if name not in known]
    if unknown:
        raise ValueError(f"ignore: got {unknown}, expected some of {', '.join(sorted(known))}")
    elements = _unsupported_elements(model)
    missing = [
        (kind, text) for kind, text in elements if "all" not in ignore and kind not in ignore
    ]
    if missing:
        lines = "".join(f"\n  {kind}: {text}" for kind, text in missing)
        names = ", ".join(repr(kind) for kind, _ in missing)
        raise UnsupportedElements(
            f"the model has elements that are not simulated:{lines}\nTo load it without them:"
            f" svkc.load(..., ignore=({names},))",
            [kind for kind, _ in elements],
        )
    touching = not is_disabled(model, "contact", "constraint")
    colliding = touching * int(np.sum((model.geom_contype != 0) | (model.geom_conaffinity != 0)))
    collisions = (
        (f"collision: {colliding} geoms of the model could touch; collisions are not simulated",)
        if colliding
        else ()
    )
    return tuple(f"{kind}: {text}" for kind, text in elements) + collisions
