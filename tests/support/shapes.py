"""Checks the shapes and dtypes of arrays at each call of a function, as its annotations have them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, get_args

from beartype import beartype
from jaxtyping import AbstractArray

_Function = TypeVar("_Function", bound=Callable[..., Any])


def checked(function: _Function) -> _Function:
    """The function, checked by beartype at what it says of arrays alone.

    The rest is mypy's: tests give functions parts of a protocol, and whole numbers for floats, as they may.
    """
    hints = function.__annotations__
    function.__annotations__ = {name: hint if _tells_of_arrays(hint) else Any for name, hint in hints.items()}
    return beartype(function)


def _tells_of_arrays(hint: object) -> bool:
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        return True
    return any(_tells_of_arrays(part) for part in get_args(hint))
