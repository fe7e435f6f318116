"""Which channels of a file cannot be used as they are, and which may be something under another name."""

from __future__ import annotations

import numpy as np

from overtone.inspection.look import Look
from overtone.quantities import quantity

LARGEST_DEFLECTION = 5e-9
"""Mean deflection above which an offset or a set-point is in A0 [m]."""
# Parts of names that no amplitude and no phase has.
_OTHER_WORDS = (
    "height",
    "topo",
    "current",
    "friction",
    "lateral",
    "freq",
    "error",
    "deflect",
    "force",
    "iprobe",
    "excitation",
)
_SPARE = "user"  # how inputs of the user's own begin, which may hold another lock-in


def unused(look: Look) -> dict[str, str]:
    """Return for each observable whose channel cannot be used as it is why, in a few words."""
    reasons = {}
    for name, channel in look.chosen.items():
        record = quantity(name)
        wanted = record.unit if record else None
        if channel.name in look.request.scales or channel.unit == wanted:
            continue
        if channel.unit is None:
            reasons[name] = "no unit"
        elif channel.unit == "V" and wanted == "m":
            if f"scale:{channel.name}" not in look.recording.facts:
                reasons[name] = "no sensitivity"
        else:
            reasons[name] = f"not in {wanted}"
    if (
        "A0" in look.chosen
        and "A0" not in reasons
        and abs(mean_deflection(look)) > LARGEST_DEFLECTION
        and not look.curve
    ):
        reasons["A0"] = "an offset or a set-point is in it"
    return reasons


def spare_channels(look: Look) -> list[str]:
    """Return channels of the user's own inputs that nothing uses."""
    used = {channel.name for channel in look.chosen.values()}
    names = (c.name for c in look.recording.channels if not c.nap and c.name.lower().startswith(_SPARE))
    return [name for name in dict.fromkeys(names) if name not in used]


def nameable_channels(look: Look, units: tuple[str | None, ...]) -> list[str]:
    """Return channels that may be an amplitude or a phase under a name of their own, in the order of these units."""
    used = {channel.name for channel in look.chosen.values()}
    found = (c for c in look.recording.channels if c.unit in units and not c.nap and c.name not in used)
    names = [channel.name for channel in sorted(found, key=lambda channel: units.index(channel.unit))]
    return [name for name in dict.fromkeys(names) if not any(word in name.lower() for word in _OTHER_WORDS)]


def mean_deflection(look: Look) -> float:
    """Return the mean of the channel of A0 [m, where its unit or its scale is known]."""
    channel = look.chosen["A0"]
    values = channel.values[np.isfinite(channel.values)]
    scale = look.request.scales.get(channel.name, 1.0)
    if channel.unit == "V" and channel.name not in look.request.scales:
        fact = look.recording.facts.get(f"scale:{channel.name}")
        scale = fact.value if fact is not None else 1.0
    return float(values.mean()) * scale if values.size else 0.0
