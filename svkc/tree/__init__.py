"""Open chains: spatial algebra, kinematics, inverse dynamics, mass matrix, articulated bodies,
energy."""
