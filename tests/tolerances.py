"""The three tolerances of the tests, absolute on numbers of order one and else relative. Bounds of
other sizes stand in the tests that they belong to."""

# one number by two ways in float64: some thousand operations, of 1.1e-16 each
ROUND_OFF = 1e-12
# against an independent solution, or after a run: what is left of a solver at rtol 1e-11 or below,
# and of round-off by inertia matrices with condition numbers of up to a million
REFERENCE = 1e-9
# a derivative against central differences, which lose half of the digits or more
DIFFERENCE = 1e-6
