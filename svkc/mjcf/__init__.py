"""Models in and out: MJCF and URDF by MuJoCo, virtual links from equalities, a chain as MJCF."""
