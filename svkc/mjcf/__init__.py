"""Loading of MJCF and URDF through MuJoCo, and conversion of chains and states to MuJoCo."""
