"""Whether a state persists: Floquet multipliers of the motion."""

from __future__ import annotations

from typing import Any

import numpy as np


def is_stable(probe: Any, all_laws: Any, states: Any) -> Any:
    return states.status == 0


def where_it_settles(probe: Any, all_laws: Any, start: Any, height: float) -> Any:
    return None
