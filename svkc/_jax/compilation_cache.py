"""JAX's persistent compilation cache, set up for the command line and the tests.

Importing svkc does not change a user's settings: only `use_cache` does.
"""

# jax.config's settings have no annotations, and a method of JAX's cache is replaced
# pyright: reportAttributeAccessIssue=false

import contextlib
import hashlib
import importlib.metadata
import os
import pathlib
import platform
import re
import sys
import tempfile
import threading

# of all processors and versions of jaxlib together
MAX_BYTES = 512 * 2**20
# fields of /proc/cpuinfo that the compiled code depends on
CPUINFO_KEYS = (
    "vendor_id",
    "cpu family",
    "model",
    "model name",
    "flags",
    "CPU implementer",
    "CPU part",
    "Features",
)
# XLA reports these preferences of LLVM as missing features of the processor (openxla/xla issue
# 44565)
FALSE_WARNING = re.compile(
    rb"cpu_aot_loader\.cc.*Target machine feature \+prefer-no-(gather|scatter) is not"
)
_stderr_lock = threading.Lock()


def use_cache() -> pathlib.Path | None:
    """Enable JAX's persistent compilation cache in this process, and return its folder.

    Return None if there is no usable folder. Call this function before the first compilation.

    $SVKC_CACHE_DIR names another folder, or is `off`. If $SVKC_CACHE_DIR is not set and
    $JAX_COMPILATION_CACHE_DIR is, JAX's own setting is kept.
    """
    import jax

    if (
        os.environ.get("SVKC_CACHE_DIR") in (None, "", "off")
        and jax.config.jax_compilation_cache_dir
    ):
        return pathlib.Path(jax.config.jax_compilation_cache_dir)
    if not jax.config.jax_enable_compilation_cache:
        return None
    # without a home directory, or with a read-only one, there is no cache
    with contextlib.suppress(OSError, RuntimeError):
        root = _root_folder()
        folder = root and root / f"jaxlib-{importlib.metadata.version('jaxlib')}-{processor_id()}"
        if root and folder and _make_private(root) and _make_private(folder):
            _prune(root)
            jax.config.update("jax_compilation_cache_dir", str(folder))
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
            _patch_jax()
            return folder
    return None


def _root_folder() -> pathlib.Path | None:
    """Return the folder of all versions and processors, or None if $SVKC_CACHE_DIR is `off`."""
    setting = os.environ.get("SVKC_CACHE_DIR")
    if setting is not None:
        return pathlib.Path(setting).expanduser().absolute() if setting not in ("", "off") else None
    if sys.platform == "darwin":
        return pathlib.Path.home() / "Library" / "Caches" / "svkc"
    user_cache = os.environ.get("LOCALAPPDATA" if sys.platform == "win32" else "XDG_CACHE_HOME")
    return (pathlib.Path(user_cache) if user_cache else pathlib.Path.home() / ".cache") / "svkc"


def processor_id(cpuinfo: str = "/proc/cpuinfo") -> str:
    """Return the model name of the processor, followed by a hash of its features."""
    try:
        lines = pathlib.Path(cpuinfo).read_text().partition("\n\n")[0].splitlines()
        fields = {
            name.strip(): value.strip()
            for name, _, value in (line.partition(":") for line in lines)
        }
    except OSError:
        fields = {"model name": platform.processor() or platform.machine()}
    model = re.sub(r"[^A-Za-z0-9]+", "-", fields.get("model name", platform.machine())).strip("-")
    features = repr([fields.get(name) for name in CPUINFO_KEYS])
    return f"{model}-{hashlib.sha256(features.encode()).hexdigest()[:12]}"


def _make_private(folder: pathlib.Path) -> bool:
    """Make a folder with mode 0700, and return whether the cache may use the folder.

    Return False if another user owns the folder or can write to it: programs in the cache are
    executed.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    status = folder.stat()
    if hasattr(os, "getuid") and (status.st_uid != os.getuid() or status.st_mode & 0o022):
        print(
            f"svkc: no cache of compiled programs: others own {folder} or can write to it",
            file=sys.stderr,
        )
        return False
    return True


def _prune(root: pathlib.Path):
    """Remove the least recently used files until the rest takes at most `MAX_BYTES`."""
    files = []
    for path in root.glob("jaxlib-*/**/*"):
        # another process may have removed the file
        with contextlib.suppress(OSError):
            status = path.stat()
            last_used = max(status.st_atime, status.st_mtime)
            files += [(last_used, status.st_size, path)] * path.is_file()
    total = sum(size for _, size, _ in files)
    for _, size, path in sorted(files):
        if total <= MAX_BYTES:
            return
        path.unlink(missing_ok=True)
        total -= size


def _patch_jax():
    """Make JAX write cache entries atomically, and load them without false warnings.

    If the installed JAX lacks the names patched here, nothing is patched.
    """
    with contextlib.suppress(ImportError, AttributeError):
        from jax._src import compilation_cache, lru_cache

        if lru_cache.LRUCache.put is not _write_entry:
            quiet = _without_false_warnings(compilation_cache.get_executable_and_time)
            lru_cache.LRUCache.put, compilation_cache.get_executable_and_time = _write_entry, quiet


def _write_entry(entries, key: str, value: bytes):
    """Write a cache entry atomically.

    JAX writes in place, and never replaces a truncated entry.
    """
    path = pathlib.Path(entries.path)
    # if the disk is full or read-only, the program is compiled again
    with contextlib.suppress(OSError), tempfile.TemporaryDirectory(dir=path) as temporary:
        entry = pathlib.Path(temporary, "entry")
        entry.write_bytes(value)
        entry.replace(path / f"{key}-cache")


def _without_false_warnings(load):
    """Wrap JAX's loading of a program: lines that match `FALSE_WARNING` are dropped from stderr."""

    def load_quietly(*args, **kw):
        # one thread at a time: a process has one stderr
        with _stderr_lock, tempfile.TemporaryFile() as captured:
            stderr = os.dup(2)
            os.dup2(captured.fileno(), 2)
            try:
                return load(*args, **kw)
            finally:
                os.dup2(stderr, 2)
                os.close(stderr)
                captured.seek(0)
                os.write(2, b"".join(line for line in captured if not FALSE_WARNING.search(line)))

    # TF_CPP_MIN_LOG_LEVEL=0 asks for every message of XLA
    return load if os.environ.get("TF_CPP_MIN_LOG_LEVEL") == "0" else load_quietly
