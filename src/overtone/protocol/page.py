"""The protocol as a page: one source for the terminal, for a file and for the documentation."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterable, Sequence

from overtone.probe import Probe
from overtone.protocol.numbers import (
    LADDER_WIDTH,
    ProbeNumbers,
    ladder_decimals,
    probe_numbers,
    reference_probe,
    texts,
)
from overtone.protocol.records import Step, Vendor, VendorStep, protocol, vendor, vendors

NOT_VERIFIED = "(not verified)"
"""Stands behind every step of a vendor that was not read in a public document or a real file."""

_WIDTH = 120

_OF_THE_VENDOR = """Steps in the software of a vendor name the document or file that they were read in. None of them was
tried at an instrument, and versions differ. Those marked {mark} are from memory: look before you press."""


def vendor_page(key: str, probe: Probe | None = None, notes: Iterable[str] = ()) -> str:
    """Return the protocol for one vendor as Markdown.

    Parameters
    ----------
    key : str
        One of `overtone.protocol.vendors`.
    probe : Probe, optional
        Whose numbers to print; those of the reference lever without one.
    notes : iterable of str
        What has to be said about the probe, a sentence each.

    Raises
    ------
    OvertoneError
        If there is no such vendor.
    """
    chosen = vendor(key)
    numbers = probe_numbers(reference_probe() if probe is None else probe)
    head = [
        f"# {protocol().title}: {chosen.name}",
        f"For {chosen.software}. {chosen.files}",
        _OF_THE_VENDOR.format(mark=NOT_VERIFIED),
        protocol().introduction,
        _numbers_section(numbers, own=probe is not None, notes=notes),
    ]
    steps = [
        _step(number, step, numbers, chosen.at(step.key)) for number, step in enumerate(protocol().steps, 1)
    ]
    return _page([*head, *steps, *_closing()])


def full_page() -> str:
    """Return the steps of all vendors as one page of Markdown: the page of the documentation."""
    numbers = probe_numbers(reference_probe())
    head = [
        f"# {protocol().title}",
        "Written by `overtone protocol --all -o docs/protocol.md`; a test holds this page against the program. At the "
        'microscope, `overtone protocol --vendor asylum --probe PPP-NCLR --free-amplitude "40 nm"` prints one vendor '
        f"and the numbers of one probe. Vendors: {', '.join(f'`{key}`' for key in vendors())}.",
        protocol().introduction,
        _numbers_section(numbers, own=False),
    ]
    steps = [_step(number, step, numbers, ()) for number, step in enumerate(protocol().steps, 1)]
    parts = ["## In the software of the vendors", _OF_THE_VENDOR.format(mark=NOT_VERIFIED)]
    parts += [_vendor_section(vendor(key)) for key in vendors()]
    return _page([*head, *steps, *_closing(), *parts])


def _page(parts: Sequence[str]) -> str:
    """Return the parts as a page, every paragraph and list entry wrapped alike."""
    blocks = [block for part in parts for block in part.strip().split("\n\n")]
    return "\n\n".join(_wrapped(block) for block in blocks) + "\n"


def _wrapped(block: str) -> str:
    if block.startswith(("|", "#")):
        return block
    if block.startswith("- "):
        return "\n".join(_fill(entry, indent="  ") for entry in re.split(r"\n(?=- )", block))
    return _fill(block)


def _fill(text: str, indent: str = "") -> str:
    words = " ".join(text.split())
    # What would begin a list or a heading at the start of a line stays with the word before it.
    glued = re.sub(r" (?=(?:[-+*#>|]|\d+[.)]) )", "\0", words[2:] if indent else words)
    glued = glued.replace(NOT_VERIFIED, NOT_VERIFIED.replace(" ", "\0"))
    glued = f"- {glued}" if indent else glued
    lines = textwrap.wrap(
        glued, _WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )
    return "\n".join(lines).replace("\0", " ")


def _step(number: int, step: Step, numbers: ProbeNumbers, special: Sequence[VendorStep]) -> str:
    words = texts(numbers) | {"last_steps": str(_number("after"))}
    parts = [
        f"## {number}. {step.title}",
        f"**Do.** {step.do.format_map(words)}",
        f"**Why.** {step.why.format_map(words)}",
        f"**It worked if:** {step.check.format_map(words)}",
    ]
    if special:
        parts.insert(2, "\n".join(_vendor_line(entry) for entry in special))
    return "\n\n".join(parts)


def _vendor_line(entry: VendorStep) -> str:
    if entry.verified:
        return f"- {entry.do} *Source: {entry.source}.*"
    return f"- {entry.do} **{NOT_VERIFIED}**"


def _vendor_section(chosen: Vendor) -> str:
    parts = [f"### {chosen.name}", f"`--vendor {chosen.key}`: {chosen.software}. {chosen.files}"]
    for number, step in enumerate(protocol().steps, 1):
        entries = chosen.at(step.key)
        if entries:
            parts += [f"**Step {number}: {step.title}**", "\n".join(_vendor_line(entry) for entry in entries)]
    return "\n\n".join(parts)


def _number(key: str) -> int:
    return [step.key for step in protocol().steps].index(key) + 1


def _closing() -> list[str]:
    return [f"## {section.title}\n\n{section.text}" for section in protocol().closing]


# --- the numbers of a probe -----------------------------------------------------------------------


def _numbers_section(numbers: ProbeNumbers, *, own: bool, notes: Iterable[str] = ()) -> str:
    """Return the table of numbers and the ladder; they are those of the user's own probe, or of the reference."""
    title = "Numbers of your probe" if own else "Numbers of the reference lever"
    hint = "" if own else " With `--probe` the page has those of your probe, here and in the steps."
    words = texts(numbers)
    lead = (
        f"{words['stiffness']}, {words['frequency']}, Q {numbers.quality_factor:.4g}, driven at "
        f"{words['drive_frequency']} with {words['free_amplitude']}.{hint}"
    )
    remarks = "\n".join(f"- {note}" for note in notes)
    tables = [_table(("number", "value"), _rows(numbers, own=own)), _ladder(numbers)]
    return "\n\n".join([f"## {title}", lead, *([remarks] if remarks else []), *tables])


def _rows(numbers: ProbeNumbers, *, own: bool) -> list[tuple[str, str]]:
    words = texts(numbers)
    at_rest, at_drive, at_second = (f"{1e15 * density:.3g}" for density in numbers.noise)
    in_A0 = numbers.noise[0] * math.sqrt(numbers.filter_bandwidth)
    in_A2 = numbers.noise[2] * math.sqrt(2.0 * numbers.filter_bandwidth)
    rows = [
        ("linewidth f1/Q", words["linewidth"]),
        ("ring-down 2Q/w", words["ring_down"]),
        ("shortest pixel, four ring-downs", words["pixel_time"]),
        (f"fastest line of {words['line_points']} pixels, trace and retrace", words["line_rate"]),
        ("filter that is as slow as the lever, first order", words["filter_corner"]),
        ("fastest approach", words["approach_speed"]),
        ("least height of the lift pass", words["lift_height"]),
        ("phase lag of the free lever", words["far_phase"]),
        ("drive or resonance that turn it by 0.1 deg", words["tenth_degree"]),
        ("drive force A1far / abs(G)", words["drive_force"]),
        (
            "thermal noise at 0, f and 2f, room temperature",
            f"{at_rest}, {at_drive} and {at_second} fm/sqrt(Hz)",
        ),
        (
            "the same on A0 and A2 behind that filter",
            f"{1e15 * in_A0:.2g} and {1e15 * in_A2:.2g} fm; a detector adds 25 to 100 fm/sqrt(Hz)",
        ),
    ]
    if own:
        rows.append(
            (
                "errors of A0, phi1 and drive that make the force errors of the table above",
                f"{1e12 * numbers.tolerated_A0:.2g} pm, "
                f"{math.degrees(numbers.tolerated_phase):.2g} deg and {100 * numbers.tolerated_drive:.2g} %",
            )
        )
    return rows


def _ladder(numbers: ProbeNumbers) -> str:
    """Return the far-field ladder: where to drive, where to listen, and what a linear lever shows there."""
    decimals = 3 + ladder_decimals(numbers.linewidth)
    rows = [
        (
            f"{step.frequency / 1e3:.{decimals}f}",
            f"{2.0 * step.frequency / 1e3:.{decimals}f}",
            f"{1e9 * step.amplitude:.3g}",
            f"{math.degrees(step.phase):.1f}",
        )
        for step in numbers.ladder
    ]
    title = f"Far-field ladder, {LADDER_WIDTH:g} linewidths at constant drive (step {_number('ladder')}):"
    return f"{title}\n\n" + _table(
        ("drive [kHz]", "second lock-in [kHz]", "A1 expected [nm]", "lag expected [deg]"), rows
    )


def _table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
