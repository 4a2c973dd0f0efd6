"""Digests of functions and data: equal for equal content in all processes, else different."""

import functools
import importlib.util
import sys
import threading

import jax.numpy as jnp
import pytest
from processes import ROOT, run

from svkc._jax.content_digest import content_digest

SCRIPT = """
import enum, functools, math
import equinox as eqx, diffrax, jax, jax.numpy as jnp, numpy as np
import svkc
from svkc._jax.content_digest import content_digest

GAINS = {{"knee", "hip", "toe", "heel"}}

class Gain(eqx.Module):
    k: jax.Array
    def __call__(self, t, state, args):
        return self.k * jnp.sin(state.v)

class Memory:
    def __init__(self):
        self.values = [1, 2.5]
    def control(self, t, state, args):
        return self.values[0] * helper(t)

def helper(t):
    return {body}

@jax.jit
def jitted(x):
    return helper(x)

def control(t, state, args):
    return jitted(math.pi) + len(GAINS) + helper(t) + np.sum(args)

def closing(gain):
    return lambda t, state, args: gain * t

ALL = [
    control, closing(2.0), closing(jnp.ones(3)), Gain(jnp.ones(2)), Memory().control,
    functools.partial(control, args=3), eqx.filter_jit(control), diffrax.Dopri8(),
    svkc.at(0.5, cut="pin"), svkc.when(control, cut="pin"), jax.random.key(3), GAINS, jnp.add,
    np.random.default_rng(3), Gain, svkc.integrators.Replay(), enum.Enum("Kind", "a b").a,
]
if __name__ == "__main__":
    print(*map(content_digest, ALL))
"""


def digests_here(path, monkeypatch):
    """Return the digests of a script's objects, imported as a module, computed twice."""
    spec = importlib.util.spec_from_file_location("script", path)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "script", module)
    exec(compile(path.read_text(), path, "exec"), vars(module))
    digests = [content_digest(x) for x in module.ALL]
    assert digests == [content_digest(x) for x in module.ALL]
    return digests


def test_digests_are_equal_in_all_processes(tmp_path, monkeypatch):
    """With other hashes of strings, and other lines."""
    path = tmp_path / "script.py"
    path.write_text(SCRIPT.format(body="t"))
    digests = digests_here(path, monkeypatch)
    path.write_text(SCRIPT.format(body="(\n        t)  # lines do not count"))
    settings = {"PYTHONHASHSEED": "1", "PYTHONPATH": str(ROOT), "JAX_ENABLE_X64": "1"}
    done = run(path, settings=settings, optimized=False)
    assert done.stdout.split() == digests, done.stderr[-1000:]
    assert len(set(digests)) == len(digests)


def test_a_function_body_counts_wherever_it_is_reached(tmp_path, monkeypatch):
    """Directly, by a bound method, a partial, a jitted function, and a guard."""
    path, digests = tmp_path / "script.py", []
    for body in ("t", "t + 1"):
        path.write_text(SCRIPT.format(body=body))
        digests.append(digests_here(path, monkeypatch))
    changed = [i for i, (a, b) in enumerate(zip(*digests)) if a != b]
    assert changed == [0, 4, 5, 6, 9]


def closing(value):
    return lambda t, state, args: value


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (closing(1.0), closing(2.0)),
        (closing(jnp.ones(2)), closing(jnp.zeros(2))),
        (closing(1), closing(True)),
        (closing([1, [2]]), closing([1, [3]])),
        (functools.partial(closing, 1), functools.partial(closing, 2)),
        (lambda t, gain=1: t, lambda t, gain=2: t),
        (lambda t: jnp.sin(t), lambda t: jnp.cos(t)),
        ({"a": 1}, {"b": 1}),
        ((1, (2, 3)), ((1, 2), 3)),
    ],
)
def test_other_content_has_another_digest(one, other):
    assert content_digest(one) != content_digest(other)


def test_equal_content_has_one_digest():
    assert content_digest(closing(jnp.ones(2))) == content_digest(closing(jnp.ones(2)))

    def calls_itself(n):
        return calls_itself(n - 1)

    assert content_digest(calls_itself) == content_digest(calls_itself)


def test_an_object_without_content_raises():
    with pytest.raises(TypeError, match="lock"):
        content_digest(closing(threading.Lock()))
