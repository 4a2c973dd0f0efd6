"""Settings of the tests: float64, strict promotion, warnings as errors, every annotation
checked."""

import gc
import importlib.metadata
import os
import pathlib

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("MPLBACKEND", "Agg")
# most of the suite's time is compilation; the main job, its example and README's run in processes
# of their own, optimized
flags = "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"
if tuple(map(int, importlib.metadata.version("jax").split(".")[:2])) < (0, 11):
    # half the time; newer XLA has no other emitters
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
import svkc.scenes

hook.uninstall()

import cases

# a second run of the suite, and the other workers, find most programs compiled; jax's key of a
# program tells the XLA_FLAGS of tests and commands apart
svkc._jax.compilation_cache.use_cache()

# tracing makes very many small objects that stay: to look through all of them again and again took
# a tenth of the suite's time
gc.freeze()
gc.set_threshold(100_000, 20, 50)


# the longest first, so that no worker is left with one of them in the end
LONGEST = (
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
    items.sort(
        key=lambda item: (
            LONGEST.index(item.path.stem) if item.path.stem in LONGEST else len(LONGEST)
        )
    )


def pytest_configure(config):
    config.addinivalue_line("filterwarnings", "error")


@pytest.fixture(scope="session")
def high_bar():
    """Return chain and state of the main job, without joint limits, so that energy is conserved."""
    return cases.high_bar()


@pytest.fixture(autouse=True)
def room_for_programs(request):
    """Compiled programs are given up before they are too many: XLA maps memory for every kernel,
    and Linux allows a process 65530 maps.

    Not after a test of the fixture `compiled`: the next of them counts the traces of the same
    program.
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
