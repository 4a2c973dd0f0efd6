"""Virtual links, which connect and disconnect at run time, and the freedoms of their joints."""

import dataclasses
from typing import Any

import numpy as np

from svkc.model.validation import boolean, real_array

# joint -> its freedoms: rotations about x, y, z, then translations along x, y, z; the joint's axis
# is z
JOINTS = {
    "weld": (False, False, False, False, False, False),
    "hinge": (False, False, True, False, False, False),
    "slide": (False, False, False, False, False, True),
    "cylinder": (False, False, True, False, False, True),
    "universal": (True, True, False, False, False, False),
    "planar": (False, False, True, True, True, False),
    "ball": (True, True, True, False, False, False),
    "free": (True, True, True, True, True, True),
}


def joint_freedoms(joint: Any) -> tuple[bool, ...]:
    """Return the six freedoms of a joint given by name or as six Booleans.

    Raises ValueError for anything else.
    """
    if isinstance(joint, str):
        if joint in JOINTS:
            return JOINTS[joint]
    elif (
        np.iterable(joint)
        and len(freedoms := list(joint)) == 6
        and all(isinstance(x, bool | np.bool_ | int) and x in (0, 1) for x in freedoms)
    ):
        return tuple(bool(x) for x in freedoms)
    raise ValueError(
        f"joint: got {joint!r}, expected one of {', '.join(JOINTS)} or six Booleans (three"
        " rotations, three translations)"
    )


@dataclasses.dataclass(frozen=True)
class VirtualLink:
    """A massless link, child of `parent`, that coincides with its `real` link while connected.

    Connected virtual links close kinematic loops (paper, section IV).

    name: name of the virtual link.
    parent: name of a body ("world" is the ground) or of a site.
    real: name of a body or of a site.
    joint: the joint between `parent` and the virtual link: weld, hinge, slide, cylinder, universal,
        planar, ball, free, or six Booleans (three rotations, three translations).
    pos: [3] origin of the joint's frame in the parent's frame, or in the site's frame (m).
    quat: [4] orientation of the frame of `axis`, in the parent's or the site's frame (wxyz).
    real_pos: [3] origin of the joint's frame in the real link's frame, or in the site's frame (m).
        None: from the load pose, or at the site.
    real_quat: [4] orientation of the frame of `axis` in the real link's or the site's frame (wxyz).
        None: from the load pose.
    axis: [3] the joint's axis in the frame of `quat`; z of the joint's frame points along it.
    connected: whether the link is connected in the load pose.
    actuated: whether a motor drives the joint's coordinates (paper, Fig. 6).

    Raises ValueError if a field has another type or shape, a quaternion is not of unit length, or
    the axis is zero.
    """

    name: str
    parent: str
    real: str
    joint: Any = "weld"
    pos: Any = (0.0, 0.0, 0.0)
    quat: Any = (1.0, 0.0, 0.0, 0.0)
    real_pos: Any = None
    real_quat: Any = None
    axis: Any = (0.0, 0.0, 1.0)
    connected: bool = False
    actuated: bool = False

    def __post_init__(self) -> None:
        for name in ("name", "parent", "real"):
            if not isinstance(getattr(self, name), str):
                raise ValueError(
                    f"virtual link: {name} must be a name, got {getattr(self, name)!r}"
                )
        joint_freedoms(self.joint)
        for name in ("connected", "actuated"):
            boolean(f"virtual link {self.name!r}: {name}", getattr(self, name))
        for name, size in (("pos", 3), ("quat", 4), ("real_pos", 3), ("real_quat", 4), ("axis", 3)):
            value = getattr(self, name)
            if value is None and name.startswith("real"):
                continue
            value = np.asarray(real_array(f"virtual link {self.name!r}: {name}", value), float)
            if value.shape != (size,) or not np.isfinite(value).all():
                raise ValueError(
                    f"virtual link {self.name!r}: {name} must be {size} finite numbers, got {value}"
                )
            if size == 4 and abs(np.linalg.norm(value) - 1) > 1e-6:
                raise ValueError(
                    f"virtual link {self.name!r}: {name} must be a unit quaternion, got one of norm"
                    f" {np.linalg.norm(value):.6g}"
                )
        if not 0 < np.linalg.norm(np.asarray(self.axis, float)) < np.inf:
            raise ValueError(f"virtual link {self.name!r}: axis must not be zero")
