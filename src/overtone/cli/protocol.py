"""``overtone protocol``: how to record data that this program can use."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter
from rich.console import Console

from overtone.cli.options import ProbeOptions, open_probe
from overtone.errors import OvertoneError, OvertoneWarning

_WIDEST = 100


def protocol(
    *,
    vendor: str | None = None,
    probe: ProbeOptions | None = None,
    all_vendors: Annotated[bool, Parameter(name="--all", negative=())] = False,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    plain: Annotated[bool, Parameter(negative=())] = False,
) -> None:
    """Print how to record data for a modulus, step by step, with the numbers of a probe.

    Parameters
    ----------
    vendor : str
        Whose software: asylum, bruker, park, jpk, nanosurf or lock-in (external).
    probe : ProbeOptions
        Probe file, or preset with what was measured; without it the page has the numbers of a stiff lever.
    all_vendors : bool
        The page of the documentation, with every vendor.
    output : Path
        Write the page to a file (.md) instead.
    plain : bool
        Markdown as it is; so also where the output is not a terminal.
    """
    from overtone.protocol import full_page, vendor_page, vendors

    if all_vendors and (vendor is not None or probe is not None):
        raise OvertoneError(
            "--all is the page of the documentation", expected="neither --vendor nor --probe beside it"
        )
    if all_vendors:
        page = full_page()
    elif vendor is None:
        raise OvertoneError(
            "no vendor", expected=f"--vendor {', '.join(vendors())}, or --all", hint="--vendor asylum"
        )
    else:
        lever, notes = (None, []) if probe is None else _open(probe)
        page = vendor_page(vendor, lever, notes)
    if output is not None:
        _write(page, output)
    else:
        _print(page, plain=plain)


def _open(options: ProbeOptions) -> tuple[Any, list[str]]:
    """Return the probe, and what is to be said about it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", OvertoneWarning)
        probe = open_probe(options)
    notes = [f"{warning.message}".rstrip(".") + "." for warning in caught]
    return probe, list(dict.fromkeys(notes))


def _write(page: str, path: Path) -> None:
    from overtone.io.atomic import atomic_path

    if path.suffix.lower() not in (".md", ".markdown", ".txt"):
        raise OvertoneError(f"{path.name} is no name for the page", expected="a name that ends in .md")
    with atomic_path(path) as temporary:
        temporary.write_text(page, encoding="utf-8", newline="\n")
    Console(highlight=False).print(f"wrote {path}", markup=False, soft_wrap=True)


def _print(page: str, *, plain: bool) -> None:
    console = Console(highlight=False)
    if plain or not console.is_terminal:
        # Line by line as it is: no wrapping, no markup.
        console.print(page, markup=False, emoji=False, soft_wrap=True, end="")
        return
    from rich.markdown import Markdown

    console.print(Markdown(page), width=min(console.width, _WIDEST))
