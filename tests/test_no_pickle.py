"""Nothing is ever unpickled: whoever can hand over a file or a message would run whatever he likes."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("bus", "deploy", "stages", "examples", "fieldpose")
MODULES = {"pickle", "_pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal", "jsonpickle"}
LOADS = {"torch.load", "torch.hub.load", "torch.jit.load", "pandas.read_pickle", "pd.read_pickle"}
YAML = {"yaml.load", "yaml.load_all", "yaml.unsafe_load", "yaml.full_load"}
RUNS = {"eval", "exec"}


def found(source: str) -> list[str]:
    """What a program has that can run what it reads, with its line."""
    return [f"{line}: {what}" for line, what in _found(ast.parse(source))]


def _found(tree: ast.AST) -> Iterator[tuple[int, str]]:
    classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    safe = {node.name for node in classes if any("SafeLoader" in ast.unparse(base) for base in node.bases)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, name.name) for name in node.names if name.name.split(".")[0] in MODULES)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in MODULES:
            yield node.lineno, str(node.module)
        elif isinstance(node, ast.Call):
            yield from _calls(node, safe)


def _calls(node: ast.Call, safe_loaders: set[str]) -> Iterator[tuple[int, str]]:
    name = ast.unparse(node.func)
    options = {keyword.arg: keyword.value for keyword in node.keywords}
    safe = options.get("weights_only")
    if name in LOADS and not (isinstance(safe, ast.Constant) and safe.value is True):
        yield node.lineno, f"{name} without weights_only=True"
    allowed = options.get("allow_pickle")
    if allowed is not None and not (isinstance(allowed, ast.Constant) and allowed.value is False):
        yield node.lineno, f"{name} with allow_pickle"
    loaders = [ast.unparse(given) for given in (*node.args[1:], *options.values())]
    if name in YAML and not any("SafeLoader" in loader or loader in safe_loaders for loader in loaders):
        yield node.lineno, f"{name} without a safe loader"
    if name in RUNS or name == "__import__":
        yield node.lineno, name


@pytest.mark.parametrize("folder", FOLDERS)
def test_nothing_is_unpickled(folder: str) -> None:
    files = [path for path in (ROOT / folder).glob("**/*.py") if not path.is_symlink()]
    assert files
    assert {str(path): what for path in files if (what := found(path.read_text(encoding="utf-8")))} == {}


@pytest.mark.parametrize(
    "program",
    [
        "import pickle", "from pickle import loads", "import torch\ntorch.load('a')", "torch.load('a', weights_only=x)",
        "np.load('a', allow_pickle=True)", "yaml.load(text, Loader=yaml.Loader)", "eval(text)", "import joblib as j",
    ],
)  # fmt: skip
def test_what_would_be_found(program: str) -> None:
    assert found(program)


def test_what_is_safe_is_not() -> None:
    safe = "torch.load('a', weights_only=True); np.load('a', allow_pickle=False); yaml.load(t, Loader=yaml.SafeLoader)"
    assert found(safe) == []
