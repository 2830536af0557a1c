"""What is part of the repository but not of an installed package."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType

import deploy
from deploy.errors import UsageError

ROOT = Path(deploy.__file__).resolve().parent.parent


def benchmark(name: str) -> ModuleType:
    """A module of tests/benchmark. Raises UsageError where there is no repository around this package."""
    if not (ROOT / "tests" / "benchmark").is_dir():
        raise UsageError("the benchmarks are part of the repository: clone it, and `make install` there")
    if str(ROOT) not in sys.path:
        sys.path.append(str(ROOT))
    return importlib.import_module(f"tests.benchmark.{name}")
