"""The three tolerances of the tests: absolute for numbers of order one, otherwise relative.

A test with another bound states the bound and its reason.
"""

# the same algebra in another order, in float64: thousands of operations, each with an error of
# 1.1e-16
ROUND_OFF = 1e-12
# another algorithm, or the end of a run: the error of a solver at rtol 1e-11, and round-off
# amplified by mass matrices with condition numbers of up to a million
REFERENCE = 1e-9
# a derivative against central differences, which lose half of the digits or more
DIFFERENCE = 1e-6
