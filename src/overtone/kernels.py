"""Flags of every compiled kernel, in one place.

Compiled once and kept on disk; free of the interpreter lock, so that threads share the cores; IEEE division
instead of exceptions, which halves the code; and no wrappers for C callers, which nobody uses. Kernels never
reorder arithmetic (no fastmath): results are the same on every machine.
"""

from __future__ import annotations

from typing import Any

KERNEL: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
"""For functions that Python code calls."""

INNER: dict[str, Any] = {**KERNEL, "no_cpython_wrapper": True}
"""For helpers that only kernels call: compiling a wrapper for Python would cost as much as the helper."""
