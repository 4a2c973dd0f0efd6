"""Settings of the tests: float64, strict promotion, warnings as errors, checked annotations."""

import gc
import importlib.metadata
import os
import pathlib
import time

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("MPLBACKEND", "Agg")
# most of the suite's time is compilation, so XLA does not optimize; the main job, its example and
# that of the README run in separate processes, with optimization
flags = "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"
if tuple(map(int, importlib.metadata.version("jax").split(".")[:2])) < (0, 11):
    # halves the time of compilation; newer XLA lacks this option
    flags += " --xla_cpu_use_fusion_emitters=false"
os.environ.setdefault("XLA_FLAGS", flags)

import jax
import pytest
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

hook = install_import_hook("svkc", "beartype.beartype")
import svkc
import svkc.__main__
import svkc._jax.compilation_cache
import svkc.optimize
import svkc.scenes
import svkc.scenes.backflip_problem

hook.uninstall()

import cases

# a second run of the suite, and other workers, load most programs from this cache; jax's cache key
# contains XLA_FLAGS, so that tests and commands do not share programs
svkc._jax.compilation_cache.use_cache()

# the garbage collector repeatedly scanned the many small objects that tracing leaves, which took a
# tenth of the suite's time
gc.freeze()
gc.set_threshold(100_000, 20, 50)


# these files run first, so that no worker is still running one of them at the end
LONGEST_FILES = (
    "test_examples",
    "test_commands",
    "test_transformations",
    "test_derivatives",
    "test_simulate",
    "test_extremes",
    "test_reference",
    "test_cuttable_joints",
    "test_accuracy",
)


def pytest_collection_modifyitems(items):
    """Move the tests of the longest files to the front."""
    items.sort(
        key=lambda item: (
            LONGEST_FILES.index(item.path.stem)
            if item.path.stem in LONGEST_FILES
            else len(LONGEST_FILES)
        )
    )


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Skip a test that would start after $SVKC_TESTS_END, a time in seconds since 1970.

    A run that has to end by a given time, on a machine of unknown speed, then names the tests that
    it left out. Without the variable every test runs.
    """
    end = os.environ.get("SVKC_TESTS_END")
    if end and time.time() > float(end):
        pytest.skip(f"LEFT OUT: {item.nodeid} would start after $SVKC_TESTS_END")


def pytest_configure(config):
    """Turn warnings into errors."""
    config.addinivalue_line("filterwarnings", "error")


@pytest.fixture(scope="session")
def high_bar():
    """Return chain and state of the main job, without joint limits, so that energy is conserved."""
    return cases.high_bar()


@pytest.fixture(autouse=True)
def limit_compiled_programs(request):
    """Clear JAX's caches after a test if the process has more than 30000 memory maps.

    XLA maps memory for every kernel, and Linux allows a process 65530 maps. Caches are kept after a
    test with the fixture `compiled`, because the next such test counts traces of the same program.
    """
    yield
    maps = pathlib.Path("/proc/self/maps")
    if (
        "compiled" not in request.fixturenames
        and maps.exists()
        and maps.read_bytes().count(b"\n") > 30000
    ):
        jax.clear_caches()
        gc.collect()
