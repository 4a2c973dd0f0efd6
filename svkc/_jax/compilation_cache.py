"""Compiled programs kept on disk from one process to the next, for the command line and the tests.
A library user's settings stay as they are."""

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

MAX_BYTES = 512 * 2**20  # bytes, of all processors and versions together
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
    """Set jax's persistent cache in this process, and return its folder: None without one. Call it
    before the first program is compiled.

    $SVKC_CACHE_DIR names another folder, or is `off`. If it is not set and
    JAX_COMPILATION_CACHE_DIR is, jax's own setting is kept.
    """
    import jax

    if (
        os.environ.get("SVKC_CACHE_DIR") in (None, "", "off")
        and jax.config.jax_compilation_cache_dir
    ):
        return pathlib.Path(jax.config.jax_compilation_cache_dir)
    if not jax.config.jax_enable_compilation_cache:
        return None
    # without a home, or in one that is read only, programs are compiled anew
    with contextlib.suppress(OSError, RuntimeError):
        top = _root_folder()
        folder = top and top / f"jaxlib-{importlib.metadata.version('jaxlib')}-{processor_id()}"
        if folder and _make_private(top) and _make_private(folder):
            _prune(top)
            jax.config.update("jax_compilation_cache_dir", str(folder))
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
            _patch_jax()
            return folder
    return None


def _root_folder() -> pathlib.Path | None:
    """Return the folder of all versions and processors, None where the user wants none."""
    named = os.environ.get("SVKC_CACHE_DIR")
    if named is not None:
        return pathlib.Path(named).expanduser().absolute() if named not in ("", "off") else None
    if sys.platform == "darwin":
        return pathlib.Path.home() / "Library" / "Caches" / "svkc"
    usual = os.environ.get("LOCALAPPDATA" if sys.platform == "win32" else "XDG_CACHE_HOME")
    return (pathlib.Path(usual) if usual else pathlib.Path.home() / ".cache") / "svkc"


def processor_id(cpuinfo: str = "/proc/cpuinfo") -> str:
    """Name the model of the processor, with a hash of its features."""
    try:
        lines = pathlib.Path(cpuinfo).read_text().partition("\n\n")[0].splitlines()
        told = {
            name.strip(): value.strip()
            for name, _, value in (line.partition(":") for line in lines)
        }
    except OSError:
        told = {"model name": platform.processor() or platform.machine()}
    model = re.sub(r"[^A-Za-z0-9]+", "-", told.get("model name", platform.machine())).strip("-")
    described = repr([told.get(name) for name in CPUINFO_KEYS])
    return f"{model}-{hashlib.sha256(described.encode()).hexdigest()[:12]}"


def _make_private(folder: pathlib.Path) -> bool:
    """Make a folder of mode 0700 and return True. Return False for one that others own or can write
    to, as its programs are executed."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    found = folder.stat()
    if hasattr(os, "getuid") and (found.st_uid != os.getuid() or found.st_mode & 0o022):
        print(
            f"svkc: no cache of compiled programs: others own {folder} or can write to it",
            file=sys.stderr,
        )
        return False
    return True


def _prune(top: pathlib.Path):
    """Remove the least recently used files until the others take at most `SIZE`."""
    files = []
    for path in top.glob("jaxlib-*/**/*"):
        # another process may remove it now
        with contextlib.suppress(OSError):
            found = path.stat()
            files += [(max(found.st_atime, found.st_mtime), found.st_size, path)] * path.is_file()
    total = sum(size for _, size, _ in files)
    for _, size, path in sorted(files):
        if total <= MAX_BYTES:
            return
        path.unlink(missing_ok=True)
        total -= size


def _patch_jax():
    """Make jax write entries atomically, and load them without false warnings. If a later jax lacks
    the names patched here, nothing is patched."""
    with contextlib.suppress(ImportError, AttributeError):
        from jax._src import compilation_cache, lru_cache

        if lru_cache.LRUCache.put is not _write_entry:
            quiet = _without_false_warnings(compilation_cache.get_executable_and_time)
            lru_cache.LRUCache.put, compilation_cache.get_executable_and_time = _write_entry, quiet


def _write_entry(entries, key: str, value: bytes):
    """Write an entry atomically. jax writes in place, and never replaces an entry that was cut
    short."""
    path = pathlib.Path(entries.path)
    # a full disk, or one that is read only: the program is compiled again
    with contextlib.suppress(OSError), tempfile.TemporaryDirectory(dir=path) as aside:
        whole = pathlib.Path(aside, "whole")
        whole.write_bytes(value)
        whole.replace(path / f"{key}-cache")


def _without_false_warnings(load):
    """Wrap jax's loading of a program so that the warnings of `PREFERENCE` are dropped from
    stderr."""

    def quiet(*args, **kw):
        # one at a time, as the process has one stderr
        with _stderr_lock, tempfile.TemporaryFile() as heard:
            kept = os.dup(2)
            os.dup2(heard.fileno(), 2)
            try:
                return load(*args, **kw)
            finally:
                os.dup2(kept, 2)
                os.close(kept)
                heard.seek(0)
                os.write(2, b"".join(line for line in heard if not FALSE_WARNING.search(line)))

    # the user may ask for all that XLA says
    return load if os.environ.get("TF_CPP_MIN_LOG_LEVEL") == "0" else quiet
