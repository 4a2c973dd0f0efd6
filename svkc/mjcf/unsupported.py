"""What a MuJoCo model may hold that svkc does not simulate, said all at once."""

import numpy as np


def plain_motors(model) -> np.ndarray:
    """[nu] Boolean: the actuator is a torque on a joint, gear times control."""
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
    plain &= model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_FIXED)
    return plain & (model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_NONE))


KINDS = frozenset(
    "tendon actuator equality friction contact gravcomp fluid polynomial plastic actuatorforce"
    " actuatorgravcomp actuatordamping balllimit flex mocap plugin".split()
)


def _findings(model) -> list[tuple[str, str]]:
    """(kind, what was found) for everything that would change the motion and is not simulated."""
    import mujoco

    def any_of(name) -> bool:
        return bool(np.any(getattr(model, name, 0)))

    supported = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))
    other = [
        mujoco.mjtEq(int(t)).name[5:].lower() for t in model.eq_type if int(t) not in supported
    ]
    tendon = [
        n
        for n in ("stiffness", "damping", "limited", "frictionloss", "armature")
        if any_of(f"tendon_{n}")
    ]
    pulled = [
        i
        for i in range(model.nu)
        if int(model.actuator_trntype[i]) == int(mujoco.mjtTrn.mjTRN_TENDON)
    ]
    complex_motors = np.flatnonzero(~plain_motors(model))
    fluid = model.opt.density != 0 or model.opt.viscosity != 0
    balls = [
        j
        for j in range(model.njnt)
        if model.jnt_limited[j] and int(model.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_BALL)
    ]
    checks = [
        (
            "tendon",
            tendon or pulled,
            f"{model.ntendon} tendons with {', '.join(tendon) or 'actuators'}",
        ),
        (
            "actuator",
            len(complex_motors),
            f"{len(complex_motors)} actuators that are not a torque on a joint (motor with gear)",
        ),
        (
            "equality",
            other,
            f"equality constraints: {', '.join(other)} (connect and weld are supported)",
        ),
        ("friction", any_of("dof_frictionloss"), "joint friction loss"),
        ("contact", model.npair, f"{model.npair} explicit contact pairs"),
        ("gravcomp", any_of("body_gravcomp"), "gravity compensation"),
        (
            "fluid",
            fluid,
            f"fluid forces (density {model.opt.density:g}, viscosity {model.opt.viscosity:g})",
        ),
        (
            "polynomial",
            any_of("jnt_stiffnesspoly") or any_of("dof_dampingpoly"),
            "polynomial stiffness or damping of joints",
        ),
        ("plastic", any_of("nplastic"), "plastic joint springs"),
        (
            "actuatorforce",
            model.nu and any_of("jnt_actfrclimited"),
            "joint limits on actuator force",
        ),
        ("actuatorgravcomp", any_of("jnt_actgravcomp"), "gravity compensation by actuators"),
        (
            "actuatordamping",
            any_of("actuator_damping") or any_of("actuator_armature"),
            "damping or armature of actuators",
        ),
        ("balllimit", balls, f"{len(balls)} ball joints with a range"),
        (
            "flex",
            getattr(model, "nflex", 0),
            f"{getattr(model, 'nflex', 0)} deformable (flex) bodies",
        ),
        ("mocap", model.nmocap, f"{model.nmocap} mocap bodies"),
        ("plugin", model.nplugin, f"{model.nplugin} plugins"),
    ]
    return [(kind, text) for kind, found, text in checks if found]


def what_is_left_out(model, ignore) -> tuple[str, ...]:
    """What the chain will lack, by name; ValueError listing every element that is neither simulated
    nor ignored."""
    known = {"all", "limit", "spring", "damping", "armature", "collision"} | KINDS
    unknown = [name for name in ignore if name not in known]
    if unknown:
        raise ValueError(f"ignore: got {unknown}, expected some of {', '.join(sorted(known))}")
    found = _findings(model)
    missing = [(kind, text) for kind, text in found if "all" not in ignore and kind not in ignore]
    if missing:
        lines = "".join(f"\n  {kind}: {text}" for kind, text in missing)
        names = ", ".join(repr(kind) for kind, _ in missing)
        raise ValueError(
            f"the model has elements that are not simulated:{lines}\nTo load it without them:"
            f" svkc.load(..., ignore=({names},))"
        )
    colliding = int(np.sum((model.geom_contype != 0) | (model.geom_conaffinity != 0)))
    collisions = (
        (f"collision: {colliding} geoms of the model could touch; collisions are not simulated",)
        if colliding
        else ()
    )
    return tuple(f"{kind}: {text}" for kind, text in found) + collisions
