"""What a file holds, what is missing, what to ask for, and what it can give, in plain language."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import xarray as xr

from overtone.errors import ChannelWarning, DistortionWarning, ResonanceWarning
from overtone.inspection.asks import asks_of, probe_file
from overtone.inspection.channels import unused
from overtone.inspection.look import Look, look_at
from overtone.inspection.needs import TOO_LARGE, needs_of
from overtone.inspection.records import Inspection, as_sentence
from overtone.inspection.results import inspect_result, is_result
from overtone.inspection.tables import channel_rows, format_title, setting_rows, size_text
from overtone.inspection.verdicts import missing_of, verdicts_of
from overtone.io import netcdf, zarr_store
from overtone.io.recording import Recording
from overtone.io.registry import read_channels
from overtone.io.selection import Request
from overtone.io.vendors import vendor_of
from overtone.probe import Probe

# The other warnings say what is missing or to be asked for, which the inspection says itself.
_KEPT = (ResonanceWarning, ChannelWarning, DistortionWarning)
_SAID_ELSEWHERE = (
    "no resonance of the file fits",
    "the file says",
    "most pixels",
    "A0 is as the file stores it",
    "an optical lever reads slope",
)
_KINDS = {"frame": "video", "z": "curve", "point": "points"}


def inspect_scan(
    path: str | Path,
    *,
    probe: Probe | None = None,
    channels: Mapping[str, str] | None = None,
    scales: Mapping[str, float] | None = None,
    far_phase: float | None = None,
    phase_sign: int = 1,
    direction: str | None = None,
    corrected: bool = False,
    lift: bool = False,
    keep_offset: bool = False,
    frame: int | None = None,
    radius: float | None = None,
) -> Inspection:
    """Say what a file holds, what is missing for what, what to ask the operator for, and what it can give.

    Nothing is refused for what somebody could still answer: where `overtone.open_scan` stops, the verdict is that
    with the answer, and the answer is on the list of what to ask.

    Parameters
    ----------
    path : str or Path
        A scan, video, curve or table of any known format, or a result of overtone (netCDF, Zarr).
    probe, channels, scales, far_phase, phase_sign, direction, corrected, lift, keep_offset, frame
        As in `overtone.open_scan`: what is known already. Of a curve ``direction`` is the approach unless given.
    radius : float, optional
        Tip radius [m], where the probe has none.

    Returns
    -------
    Inspection
        Tables and sentences.

    Raises
    ------
    OvertoneError
        If the file cannot be read, or an argument names what it does not have.
    """
    source = Path(path)
    dataset = _own_dataset(source)
    if dataset is not None and is_result(dataset):
        return inspect_result(source, dataset)
    if dataset is None:
        recording = read_channels(path)
    else:
        recording = netcdf.recording_of(source, dataset, "zarr" if source.is_dir() else "netcdf")
    request = Request(
        probe,
        channels or {},
        scales or {},
        far_phase,
        phase_sign,
        direction,
        corrected,
        lift,
        keep_offset=lift or keep_offset,
        frame=frame,
    )
    look = look_at(recording, request)
    needs = needs_of(look)
    if radius is not None:
        needs["radius"] = replace(needs["radius"], state="there")
    verdicts = verdicts_of(look, needs)
    return Inspection(
        path=recording.path,
        kind=_kind(recording, look),
        format=format_title(recording.format),
        headline=_headline(recording, look),
        channels=tuple(channel_rows(recording, look.chosen, unused(look))),
        settings=tuple(setting_rows(recording)),
        missing=tuple(missing_of(look, needs)),
        asks=tuple(asks_of(look, needs)),
        verdicts=tuple(verdicts),
        remarks=tuple(_remarks(recording, look)),
        probe_file=probe_file(look, needs),
    )


def _own_dataset(path: Path) -> xr.Dataset | None:
    """Return the dataset of a file that overtone saved, None of any other."""
    if zarr_store.sniff(path, b""):
        return zarr_store.load(path)
    if path.is_file() and netcdf.is_sealed(path):
        return netcdf.load(path)
    return None


def _kind(recording: Recording, look: Look) -> str:
    if look.curve:
        return "curve"
    return next((kind for dim, kind in _KINDS.items() if dim in recording.dims), "scan")


def _headline(recording: Recording, look: Look) -> str:
    vendor = vendor_of(recording)
    by = "Unknown instrument" if vendor.key == "unknown" else vendor.title
    kind = _kind(recording, look)
    mode = f"; mode: {look.mode.title} ({look.mode.key})" if look.mode is not None else ""
    return f"{by}, {'table' if kind == 'points' else kind}: {size_text(recording)}{mode}"


def _remarks(recording: Recording, look: Look) -> list[str]:
    """Return what the reader noticed and what opening warned of, each once."""
    said = [
        text
        for kind, text in look.said
        if text.startswith(TOO_LARGE) or (issubclass(kind, _KEPT) and not text.startswith(_SAID_ELSEWHERE))
    ]
    return list(dict.fromkeys(as_sentence(text) for text in (*recording.notes, *said)))
