import ast
import importlib
import os
import pkgutil
import shutil
from pathlib import Path
from typing import Any

import numba
import pytest

from fieldpose.stages import alignment, kernel_cache
from fieldpose.stages.kernel_cache import SHARED_SOURCES, cache_folder, cached_njit, state_of
from fieldpose.stages.nerf import kernels

PACKAGES = (kernels, alignment)
KNOWN = ("fieldpose.stages.fastmath", "fieldpose.stages.kernel_cache")


def dispatchers(package: Any) -> list[Any]:
    """The compiled functions that modules of a package define, cached or not."""
    names = [f"{package.__name__}.{found.name}" for found in pkgutil.iter_modules(package.__path__)]
    modules = [importlib.import_module(name) for name in names]
    values = [value for module in modules for value in vars(module).values() if hasattr(value, "py_func")]
    return [value for value in values if value.py_func.__module__.startswith(package.__name__)]


@pytest.mark.parametrize("package", PACKAGES)
def test_every_cache_is_that_of_its_sources_as_they_are(package: Any) -> None:
    folder = Path(package.__path__[0])
    state = state_of([*folder.glob("*.py"), *SHARED_SOURCES])
    cached = [kernel.stats.cache_path for kernel in dispatchers(package) if kernel.stats.cache_path is not None]
    assert len(cached) >= 4
    assert cache_folder(folder).name == f"kernels-{state}"
    assert all(Path(path).is_relative_to(cache_folder(folder)) for path in cached)


@pytest.mark.parametrize("package", PACKAGES)
def test_kernels_use_nothing_that_their_cache_does_not_know(package: Any) -> None:
    """By the imports of the names that stand in compiled functions and their decorators."""
    for kernel in dispatchers(package):
        tree = ast.parse(Path(kernel.py_func.__code__.co_filename).read_text())
        imports = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
        origin = {alias.asname or alias.name: node.module or "" for node in imports for alias in node.names}
        functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
        defined = next(function for function in functions if function.name == kernel.py_func.__name__)
        used = {origin.get(node.id, "") for node in ast.walk(defined) if isinstance(node, ast.Name)}
        ours = {module for module in used if module.startswith("fieldpose")}
        assert all(module in KNOWN or module.startswith(package.__name__) for module in ours), ours


def test_a_change_of_any_source_is_another_state(tmp_path: Path) -> None:
    first, second = tmp_path / "a.py", tmp_path / "b.py"
    first.write_text("X = 1\n")
    second.write_text("Y = 1\n")
    states = [state_of([first, second]), state_of([second, first])]
    assert states[0] == states[1]
    second.write_text("Y = 2\n")
    states.append(state_of([first, second]))
    second.rename(tmp_path / "c.py")
    states.append(state_of([first, tmp_path / "c.py"]))
    assert len(set(states)) == 3


def test_a_kernel_is_compiled_anew_once_what_it_shares_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shared, caches = tmp_path / "shared.py", set()
    monkeypatch.setattr(kernel_cache, "SHARED_SOURCES", (shared,))
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    for content in ("X = 1\n", "X = 2\n"):
        shared.write_text(content)
        kernel_cache._state_of_folder.cache_clear()
        caches.add(cached_njit(nogil=True)(add).stats.cache_path)
    kernel_cache._state_of_folder.cache_clear()
    assert len(caches) == 2
    assert all(Path(path).is_relative_to(tmp_path / "cache") for path in caches)
    assert str(tmp_path / "cache") == numba.config.CACHE_DIR


def test_kernels_are_cached_where_something_can_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file stands where a folder would have to be, which stops even root."""
    given, package, home, temporary = (tmp_path / name for name in ("given", "package", "home", "temporary"))
    for folder in (package, home, temporary):
        folder.mkdir()
    (package / "kernel.py").write_text("X = 1\n")
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(given))
    monkeypatch.setenv("XDG_CACHE_HOME", str(home))
    monkeypatch.setattr(kernel_cache.tempfile, "gettempdir", lambda: str(temporary))
    own = temporary / f"fieldpose-{os.getuid()}"
    found = []
    for blocked in (given, package / "__pycache__", home / "fieldpose", own, None):
        kernel_cache._is_writable.cache_clear()
        found.append(cache_folder(package))
        if blocked is not None:
            shutil.rmtree(blocked, ignore_errors=True)
            blocked.write_text("")
    kernel_cache._is_writable.cache_clear()
    places = [None if folder is None else folder.parent for folder in found]
    assert places == [given, package / "__pycache__", home / "fieldpose", own, None]


def test_a_folder_that_others_may_write_to_is_not_trusted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_cache.tempfile, "gettempdir", lambda: str(tmp_path))
    own = tmp_path / f"fieldpose-{os.getuid()}"
    assert own in kernel_cache._places(tmp_path)
    own.chmod(0o777)
    assert own not in kernel_cache._places(tmp_path)


def test_without_a_cache_kernels_work_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_cache, "cache_folder", lambda folder: None)
    kernel = cached_njit(nogil=True)(add)
    assert kernel(1.0, 2.0) == 3.0
    assert kernel.stats.cache_path is None


def add(a: float, b: float) -> float:
    return a + b
