"""The persistent compilation cache: its folder, permissions, atomic writes, and XLA's warnings."""

import os
import pathlib
import stat
import sys

import jax
import pytest
from jax._src import compilation_cache, lru_cache

from svkc._jax import compilation_cache as cache

SETTINGS = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"


@pytest.fixture(autouse=True)
def unset(monkeypatch, tmp_path):
    """Disable the cache and use a temporary home directory; restore the settings afterwards."""
    before = {name: getattr(jax.config, name) for name in SETTINGS}
    kept = compilation_cache.get_executable_and_time, lru_cache.LRUCache.put
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.delenv("SVKC_CACHE_DIR", raising=False)
    monkeypatch.setattr(pathlib.Path, "home", lambda: tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "usual"))
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "usual"))
    yield
    compilation_cache.get_executable_and_time, lru_cache.LRUCache.put = kept
    for name, value in before.items():
        jax.config.update(name, value)


def mode(path):
    return stat.S_IMODE(path.stat().st_mode)


def test_the_default_folder_is_private_to_the_user(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    folder = cache.use_cache()
    assert folder.parent == tmp_path / "usual" / "svkc"
    assert folder.name.startswith(f"jaxlib-{cache.importlib.metadata.version('jaxlib')}-")
    assert jax.config.jax_compilation_cache_dir == str(folder)
    assert mode(folder) == mode(folder.parent) == 0o700
    assert cache.use_cache() == folder
    for system, place in {
        "darwin": tmp_path / "Library" / "Caches",
        "win32": tmp_path / "usual",
    }.items():
        monkeypatch.setattr(sys, "platform", system)
        assert cache._root_folder() == place / "svkc"


def test_the_folder_is_set_by_an_environment_variable(tmp_path, monkeypatch):
    for off in "off", "":
        monkeypatch.setenv("SVKC_CACHE_DIR", off)
        assert cache.use_cache() is None
        assert jax.config.jax_compilation_cache_dir is None
    monkeypatch.setenv("SVKC_CACHE_DIR", str(tmp_path / "mine"))
    jax.config.update("jax_enable_compilation_cache", False)
    assert cache.use_cache() is None
    jax.config.update("jax_enable_compilation_cache", True)
    assert cache.use_cache().parent == tmp_path / "mine"


def test_a_cache_folder_set_for_jax_is_kept(tmp_path, monkeypatch):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 2.0)
    assert cache.use_cache() == tmp_path
    assert jax.config.jax_persistent_cache_min_compile_time_secs == 2.0
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_others_can_write_to_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("SVKC_CACHE_DIR", str(tmp_path / "shared"))
    (tmp_path / "shared").mkdir()
    for bits in 0o770, 0o707:
        (tmp_path / "shared").chmod(bits)
        assert cache.use_cache() is None
        assert "others own" in capsys.readouterr().err
    (tmp_path / "shared").chmod(0o755)
    with monkeypatch.context() as patch:
        owner = os.getuid()
        patch.setattr(os, "getuid", lambda: owner + 1)
        assert cache.use_cache() is None
    assert jax.config.jax_compilation_cache_dir is None
    cache.use_cache().chmod(0o777)
    assert cache._make_private(tmp_path / "shared")
    jax.config.update("jax_compilation_cache_dir", None)
    assert cache.use_cache() is None


def test_a_folder_that_cannot_be_created_is_no_error(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("SVKC_CACHE_DIR", str(tmp_path / "file" / "under"))
    assert cache.use_cache() is None
    assert capsys.readouterr().err == ""


def test_processor_id_depends_on_model_and_features(tmp_path):
    text = "processor : 0\nmodel name : {}\nflags : {}\n\nprocessor : 1\n"
    names = set()
    for told in ("Some CPU @ 2 GHz", "sse avx"), ("Some CPU @ 2 GHz", "sse"), ("Other", "sse avx"):
        (tmp_path / "cpuinfo").write_text(text.format(*told))
        names.add(cache.processor_id(str(tmp_path / "cpuinfo")))
    assert len(names) == 3
    assert sum(name.startswith("Some-CPU-2-GHz-") for name in names) == 2
    assert cache.processor_id(str(tmp_path / "nothing"))


def test_entries_are_written_atomically(tmp_path):
    """A truncated entry is replaced, no temporary file is left, and a read-only folder raises no
    error."""
    entries = lru_cache.LRUCache(str(tmp_path), max_size=-1)
    (tmp_path / "program-cache").write_bytes(b"ha")
    cache._write_entry(entries, "program", b"half and half")
    assert entries.get("program") == b"half and half"
    assert [path.name for path in tmp_path.iterdir()] == ["program-cache"]
    cache._write_entry(lru_cache.LRUCache(str(tmp_path / "gone"), max_size=-1), "program", b"")
    (tmp_path / "gone" / "program-cache").unlink()
    (tmp_path / "gone").rmdir()
    entries.path = tmp_path / "gone"
    cache._write_entry(entries, "program", b"")


def test_the_least_recently_used_entries_are_removed(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "MAX_BYTES", 250)
    for age, version in enumerate(("one", "two", "three")):
        (tmp_path / f"jaxlib-{version}").mkdir()
        path = tmp_path / f"jaxlib-{version}" / "program-cache"
        path.write_bytes(bytes(100))
        os.utime(path, (1e9 - age, 1e9 - age))
    (tmp_path / "other").write_bytes(bytes(1000))
    cache._prune(tmp_path)
    assert {path.parent.name for path in tmp_path.glob("*/*")} == {"jaxlib-one", "jaxlib-two"}
    assert (tmp_path / "other").exists()


def test_false_warnings_are_dropped_from_stderr(monkeypatch, capfd):
    """Other messages of XLA stay, such as a missing instruction of the processor."""
    line = (
        "E1 cpu_aot_loader.cc:195] Loading XLA:CPU AOT result. Target machine feature +{} is not "
        " supported on the host machine. [+prefer-no-gather]\n"
    )
    lines = [line.format(name) for name in ("prefer-no-gather", "avx512f", "prefer-no-scatter")]

    def load(key):
        os.write(2, "".join(lines).encode())
        if key is None:
            raise ValueError("damaged")
        return key

    assert cache._without_false_warnings(load)("key") == "key"
    assert capfd.readouterr().err == lines[1]
    with pytest.raises(ValueError, match="damaged"):
        cache._without_false_warnings(load)(None)
    assert capfd.readouterr().err == lines[1]
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "0")
    cache._without_false_warnings(load)("key")
    assert capfd.readouterr().err == "".join(lines)


def test_jax_calls_the_patched_functions(tmp_path, monkeypatch):
    monkeypatch.setenv("SVKC_CACHE_DIR", str(tmp_path))
    cache.use_cache()
    assert lru_cache.LRUCache.put is cache._write_entry
    assert compilation_cache.get_executable_and_time.__module__ == "svkc._jax.compilation_cache"
