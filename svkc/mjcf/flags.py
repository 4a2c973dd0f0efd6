"""Parts of a MuJoCo model that its <option> disables."""

import numpy as np

from svkc.model.annotations import MuJoCo


def is_disabled(model: MuJoCo, *flags: str) -> bool:
    """Return whether <option><flag .../></option> disables one of these parts of the model.

    flags: names as in MJCF, such as "gravity".
    """
    import mujoco

    bits = [int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag.upper()}")) for flag in flags]
    return any(model.opt.disableflags & bit for bit in bits)


def disabled_actuators(model: MuJoCo) -> np.ndarray:
    """Return the mask of disabled actuators: those in a disabled group, or all of them."""
    # MuJoCo can disable the groups 0 to 30
    group = np.array(model.actuator_group, int)
    own = (
        (0 <= group) & (group <= 30) & (model.opt.disableactuator >> np.clip(group, 0, 30) & 1 > 0)
    )
    return own | is_disabled(model, "actuation")
