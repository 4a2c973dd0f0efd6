"""The functions of a problem as callbacks of CasADi."""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np


def _sparsity(casadi: Any, shape: tuple[int, int], row: np.ndarray, column: np.ndarray):
    """Return a sparsity pattern of CasADi, and the order of entries in it: column by column."""
    order = np.lexsort((row, column))
    pattern = casadi.Sparsity.triplet(*shape, row[order].tolist(), column[order].tolist())
    return pattern, order


def _callback_class(casadi: Any) -> Any:
    """Return the class of functions that CasADi calls."""

    class Values(casadi.Callback):
        """A function of dense inputs that returns the nonzero entries of its outputs.

        inputs, outputs: sparsity patterns by name. evaluate: (arrays) -> arrays of entries.
        """

        def __init__(self, name: str, inputs: dict, outputs: dict, evaluate: Callable):
            casadi.Callback.__init__(self)
            self.inputs, self.outputs, self.evaluate = inputs, outputs, evaluate
            self.construct(name, {})

        def get_n_in(self):
            return len(self.inputs)

        def get_n_out(self):
            return len(self.outputs)

        def get_name_in(self, i):
            return list(self.inputs)[i]

        def get_name_out(self, i):
            return list(self.outputs)[i]

        def get_sparsity_in(self, i):
            return list(self.inputs.values())[i]

        def get_sparsity_out(self, i):
            return list(self.outputs.values())[i]

        def has_eval_buffer(self):
            return True

        def eval_buffer(self, arguments, results):
            arrays = [np.frombuffer(a, float) if a is not None else np.zeros(0) for a in arguments]
            for result, value in zip(results, self.evaluate(*arrays)):
                if result is not None and len(result):
                    np.frombuffer(result, float)[:] = value
            return 0

    return Values


def iteration_callback(casadi: Any, callbacks: Any) -> Any:
    """Return the `iteration_callback` for `nlpsol`: it reports the progress, and may end the run.

    callbacks: `Callbacks` of a program.
    """
    n, m = callbacks.program.count, len(callbacks.program.solver_rows)
    size = {"x": n, "f": 1, "g": m, "lam_x": n, "lam_g": m, "lam_p": 0}
    names = [casadi.nlpsol_out(i) for i in range(casadi.nlpsol_n_out())]
    dense = casadi.Sparsity.dense

    # the first call is that of the start
    iteration = itertools.count()

    def end_or_continue(*_values: np.ndarray) -> tuple[np.ndarray]:
        return (np.array([0.0 if callbacks.intermediate(0, next(iteration)) else 1.0]),)

    inputs = {name: dense(size[name]) for name in names}
    return _callback_class(casadi)("progress", inputs, {"ret": dense(1)}, end_or_continue)


def nlp_functions(casadi: Any, callbacks: Any) -> dict[str, Any]:
    """Return the callbacks `nlp`, `grad_f`, `jac_g` and `hess_lag` for `nlpsol`.

    callbacks: `Callbacks` of a program.
    """
    program = callbacks.program
    n, m = program.count, len(program.solver_rows)
    dense = casadi.Sparsity.dense
    x, p, f, g = dense(n), dense(0), dense(1), dense(m)
    jac, jac_order = _sparsity(casadi, (m, n), *callbacks.jacobianstructure())
    row, column = callbacks.hessianstructure()
    # CasADi asks for the upper half
    hess, hess_order = _sparsity(casadi, (n, n), column, row)

    Values = _callback_class(casadi)
    c = callbacks
    point = {"x": x, "p": p}
    return {
        "nlp": Values(
            "nlp", point, {"f": f, "g": g}, lambda x, p: (c.objective(x), c.constraints(x))
        ),
        "grad_f": Values(
            "nlp_grad_f", point, {"f": f, "grad_f_x": x},
            lambda x, p: (c.objective(x), c.gradient(x)),
        ),
        "jac_g": Values(
            "nlp_jac_g", point, {"g": g, "jac_g_x": jac},
            lambda x, p: (c.constraints(x), c.jacobian(x)[jac_order]),
        ),
        "hess_lag": Values(
            "nlp_hess_l", point | {"lam_f": f, "lam_g": g}, {"triu_hess_gamma_x_x": hess},
            lambda x, p, factor, multipliers: (
                c.hessian(x, multipliers, float(factor[0]))[hess_order],
            ),
        ),
    }  # fmt: skip
