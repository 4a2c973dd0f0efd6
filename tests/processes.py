"""Python in separate processes, and checks of the pictures that they draw."""

import os
import pathlib
import subprocess
import sys
import tempfile

import jax

ROOT = pathlib.Path(__file__).parents[1]

CACHE = tempfile.TemporaryDirectory()


def run(*args, cwd=ROOT, optimized=True, settings=None):
    """Run Python with these arguments, and return the completed process with its output as text.

    optimized: whether XLA optimizes, unlike in the tests' own process.
    settings: further environment variables.
    """
    env = dict(os.environ)
    if optimized:
        env["XLA_FLAGS"] = env.get("XLA_FLAGS", "").replace(
            "--xla_backend_optimization_level=0", ""
        )
    # an example and the command of one scene share programs; their cache is separate, because jax
    # without svkc's patches, as in examples, may leave truncated entries
    kept = jax.config.jax_compilation_cache_dir
    env |= {
        "JAX_COMPILATION_CACHE_DIR": f"{kept}/processes" if kept else CACHE.name,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    env |= settings or {}
    return subprocess.run(
        [sys.executable, *map(str, args)],
        capture_output=True,
        text=True,
        cwd=cwd,
        timeout=1200,
        check=False,
        env=env,
    )


def looks_drawn(path):
    """Assert that a picture has more than twenty colors."""
    from PIL import Image

    with Image.open(path) as image:
        assert len(image.convert("RGB").getcolors(1 << 22)) > 20
