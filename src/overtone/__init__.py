"""overtone: nanomechanics from an ordinary tapping-mode AFM scan, with an answer to "how sure?".

SI units and radians everywhere. Names are imported where they are first used, so that the command
line answers quickly.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from overtone._version import __version__

if TYPE_CHECKING:
    from overtone.probe import Probe as Probe
    from overtone.probe import load_probe as load_probe
    from overtone.probe import save_probe as save_probe

_HOME = {
    "Probe": "probe",
    "load_probe": "probe",
    "save_probe": "probe",
}

__all__ = ["__version__", *_HOME]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        message = f"module 'overtone' has no attribute {name!r}"
        raise AttributeError(message)
    return getattr(import_module(f"overtone.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
