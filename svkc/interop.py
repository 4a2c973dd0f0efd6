"""States exchanged with MuJoCo, and quaternions in other libraries' order."""

from svkc.mjcf.convert import from_mujoco as from_mujoco, to_mujoco as to_mujoco
from svkc.tree.configuration import quaternions_xyzw as quaternions_xyzw
