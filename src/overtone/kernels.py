"""How kernels are compiled and where they are kept, in one place.

Compiled once and kept on disk; free of the interpreter lock, so that threads share the cores; IEEE division
instead of exceptions, which halves the code; and no wrappers for C callers, which nobody uses. Kernels never
reorder arithmetic (no fastmath): results are the same on every machine.

The compiler's own disk cache notices an edit in the file of a kernel, not one in a file that it calls, and
would go on with the old numbers. So kernels are kept in a folder named after the content of all of them.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba

_config: Any = numba.config
_Function = TypeVar("_Function", bound=Callable[..., Any])

_PACKAGE = Path(__file__).parent
_ROOMS = ("contact", "dynamics", "inversion")
_WITH_KERNELS = ("population",)  # of these rooms the files that have kernels
_FLAGS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}


def _folder() -> str:
    """Return where to keep compiled kernels, empty where the compiler shall choose."""
    sources = [Path(__file__), *(path for room in _ROOMS for path in sorted((_PACKAGE / room).glob("*.py")))]
    texts = [path.read_bytes() for path in sources]
    for room in _WITH_KERNELS:
        others = (path.read_bytes() for path in sorted((_PACKAGE / room).glob("*.py")))
        texts += [text for text in others if b"overtone.kernels" in text]
    content = hashlib.sha256(b"".join(texts)).hexdigest()[:16]
    # As the compiler does by itself: beside the sources, unless a folder is set or that one is read-only.
    base = Path(_config.CACHE_DIR) if _config.CACHE_DIR else _PACKAGE / "__pycache__"
    try:
        base.mkdir(parents=True, exist_ok=True)
    except OSError:
        return ""
    return str(base / f"kernels-{content}") if os.access(base, os.W_OK) else ""


_CACHE = _folder()


def _compile(function: _Function, **flags: Any) -> _Function:
    """Compile a function; the folder is set for this one only, not for other packages."""
    before, _config.CACHE_DIR = _config.CACHE_DIR, _CACHE or _config.CACHE_DIR
    try:
        compiled: _Function = numba.njit(**flags)(function)
    finally:
        _config.CACHE_DIR = before
    return compiled


def kernel(function: _Function) -> _Function:
    """Compile a function that Python code calls."""
    return _compile(function, **_FLAGS)


def inner(function: _Function) -> _Function:
    """Compile a helper that only kernels call: a wrapper for Python would cost as much as the helper."""
    return _compile(function, **_FLAGS, no_cpython_wrapper=True)


def lean(function: _Function) -> _Function:
    """Compile a helper of kernels that neither makes nor returns arrays: those that it is given need no counting.

    References to them are its caller's; to count them at every call costs a fifth of the time of a map.
    """
    return _compile(function, **_FLAGS, no_cpython_wrapper=True, _nrt=False)


def inlined(function: _Function) -> _Function:
    """Compile such a helper into every kernel that calls it: for what is called at each sample of a force."""
    return _compile(function, **_FLAGS, no_cpython_wrapper=True, _nrt=False, forceinline=True)
