"""Closed chains: loop Jacobian, pivots, H, W and S, forward dynamics, projection, mobility,
actuation."""
