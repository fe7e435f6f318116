"""Spectra of the deflection as files hold them: power or amplitude density over frequency.

Analysers and microscopes write either a power density (V^2/Hz, m^2/Hz) or its root (V/rtHz, m/rtHz),
nearly always one-sided: its integral over the frequencies from zero up is the mean square. Both come
out as power density in SI units.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.errors import ChannelError, ChannelWarning, FileFormatError, UnitError
from overtone.io import asylum, igor, netcdf, registry, table
from overtone.io.si import to_si
from overtone.units import parse_unit

POWER_UNITS = ("m^2/Hz", "V^2/Hz")
_FORMS = 'a power density such as "m^2/Hz" or "V^2/Hz", or an amplitude density such as "m/rtHz" or "V/rtHz"'
_ROOT = re.compile(r"(?:/|\s|\*|·)?\s*(?:rt|sqrt|√)\s*\(?\s*Hz\s*\)?|/\s*Hz\s*\^\s*(?:0?\.5|\(?1/2\)?)")
_INVERSE_ROOT = re.compile(r"[\s*·]\s*Hz\s*\^\s*\(?-\s*(?:0?\.5|1/2)\)?")
_IN_BRACKETS = re.compile(r".*?[\[(](.*)[\])]\s*")
# What Igor writes of "m/√Hz" and its kin where only four bytes or another alphabet are at hand.
_ASYLUM_AMPLITUDE = ("", "m", "m/√H", "m/rt", "m/sq")


def density_factor(unit: str) -> tuple[float, str, bool] | None:
    """Return what turns a spectral density into SI, None where the unit is none of a spectrum.

    Parameters
    ----------
    unit : str
        Unit as a file states it.

    Returns
    -------
    factor : float
        Multiplies the values.
    si : str
        ``m^2/Hz`` or ``V^2/Hz``: the power density that the values are, or that their square is.
    amplitude : bool
        Whether the values are an amplitude density, to be squared after they were multiplied.

    Examples
    --------
    >>> density_factor("pm^2/Hz"), density_factor("nV/rtHz"), density_factor("dB")
    ((1e-24, 'm^2/Hz', False), (1e-09, 'V^2/Hz', True), None)
    """
    text = unit.strip().replace("²", "^2")
    for root in (_ROOT, _INVERSE_ROOT):
        parts = root.split(text, maxsplit=1)
        if len(parts) == 2 and not parts[1].strip():
            known = to_si(parts[0].strip())
            return (known[0], f"{known[1]}^2/Hz", True) if known and known[1] in ("m", "V") else None
    try:
        factor, dimension = parse_unit(text)
    except (UnitError, ArithmeticError):
        return None
    for si in POWER_UNITS:
        if parse_unit(si)[1] == dimension:
            return factor, si, False
    return None


def read_spectrum(path: str | Path, *, channel: str | None = None, unit: str | None = None) -> xr.DataArray:
    """Read the spectrum of a deflection: CSV or TSV, an Igor wave (.ibw), or netCDF.

    Parameters
    ----------
    path : str or Path
        A table with a column of frequencies and one of densities, both with units in the header; a
        one-dimensional Igor wave that is scaled in Hz; or a netCDF file with a variable over ``frequency``.
    channel : str, optional
        Which column or variable, where there are several densities.
    unit : str, optional
        Unit of the density, where the file states none or a wrong one.

    Returns
    -------
    DataArray
        One-sided power spectral density over ``frequency`` [Hz], rising, in m^2/Hz or V^2/Hz;
        amplitude densities are squared. The attributes say what the file held (``stated_unit``).

    Warns
    -----
    ChannelWarning
        If a wave of Asylum's states no density, and is taken for m/rtHz as their software writes thermals.

    Raises
    ------
    FileFormatError
        If the file is missing or damaged, or holds no spectrum.
    ChannelError
        If it is not clear which column is meant, or which the frequency.
    UnitError
        If the unit is none of a spectral density.

    Notes
    -----
    Spectra in dB, and spectra of peak amplitude, are not read. A two-sided density is not told from a
    one-sided one: its stiffness would be twice too large.
    """
    source = Path(path)
    head = registry._head(source)
    try:
        if igor.sniff(source, head):
            frequency, values, stated, attributes = _from_igor(source, unit)
        elif netcdf.sniff(source, head):
            frequency, values, stated, attributes = _from_netcdf(source, channel)
        elif table.sniff(source, head):
            frequency, values, stated, attributes = _from_table(source, channel, unit)
        else:
            raise FileFormatError(
                f"the format of {source.name} is not known",
                expected="a table of text with units, an Igor wave (.ibw) or netCDF",
                got=repr(head[:24].decode("latin-1")),
            )
    except OSError as error:
        raise FileFormatError(f"cannot read {str(source)!r}", got=str(error.strerror or error)) from error
    stated = stated if unit is None else unit
    known = density_factor(stated)
    if known is None:
        raise UnitError(
            f"{source.name} states no unit of a spectrum",
            expected=_FORMS,
            got=repr(stated),
            hint='unit="V/rtHz", or the unit in the header of the file',
        )
    factor, si, amplitude = known
    return spectrum_array(
        frequency,
        np.square(values * factor) if amplitude else values * factor,
        si,
        source=source.name,
        stated_unit=stated,
        **attributes,
    )


def spectrum_array(
    frequency: npt.NDArray[np.float64], values: npt.NDArray[np.float64], unit: str, **attributes: Any
) -> xr.DataArray:
    """Return a one-sided power spectral density as an array over rising ``frequency``.

    Parameters
    ----------
    frequency : array, shape (n,)
        Frequencies [Hz], different from each other.
    values : array, shape (n,)
        Power density.
    unit : str
        ``m^2/Hz`` or ``V^2/Hz``.
    **attributes
        Further attributes.

    Raises
    ------
    FileFormatError
        If there are no values, or the frequencies are not finite, not from 0 up, or not different.
    """
    frequency, values = np.asarray(frequency, dtype=float), np.asarray(values, dtype=float)
    if frequency.size < 2 or frequency.shape != values.shape:
        raise FileFormatError("a spectrum without bins", expected="two or more", got=f"{frequency.size}")
    order = np.argsort(frequency, kind="stable")
    frequency, values = frequency[order], values[order]
    if not (np.isfinite(frequency).all() and frequency[0] >= 0.0 and (np.diff(frequency) > 0.0).all()):
        raise FileFormatError(
            "the frequencies of the spectrum are not usable",
            expected="finite numbers from 0 up, each once",
            got=f"{frequency[0]:g} to {frequency[-1]:g} Hz",
            hint="one spectrum a file; of a two-sided one the half of positive frequencies, doubled",
        )
    meaning = "one-sided power spectral density of the deflection"
    return xr.DataArray(
        values,
        dims=("frequency",),
        coords={"frequency": xr.DataArray(frequency, dims="frequency", attrs={"units": "Hz"})},
        name="density",
        attrs={"units": unit, "long_name": meaning, **attributes},
    )


# --- formats --------------------------------------------------------------------------------------

_Parts = tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], str, dict[str, str]]


def _from_table(path: Path, channel: str | None, unit: str | None) -> _Parts:
    recording = table.read(path)
    columns = {found.name: found for found in recording.channels}
    if recording.dims != ("point",):
        raise FileFormatError(
            f"{path.name} holds a map or a curve",
            expected="columns of frequency and density",
            got=f"{', '.join(columns)} over {' and '.join(recording.dims)}",
        )
    axes = [name for name, found in columns.items() if found.unit == "Hz"]
    if len(axes) > 1:
        axes = [name for name in axes if name.lower().startswith(("f", "ν"))][:1]
    if not axes:
        raise ChannelError(
            f"{path.name} has no column of frequencies",
            expected='a header such as "frequency [kHz], density [V^2/Hz]"',
            got=", ".join(columns),
        )
    units = _stated_units(path, [name for name in columns if name != axes[0]])
    densities = [name for name, text in units.items() if density_factor(text) is not None]
    if channel is None and not densities and unit is not None and len(units) == 1:
        densities = list(units)
    chosen = _chosen(path, channel, list(units), densities, units)
    values = columns[chosen].values
    known = columns[chosen].unit
    if known is not None:  # the table has turned it into SI, but it is no density: that is for `unit` to say
        return columns[axes[0]].values, values, known, {"channel": chosen}
    return columns[axes[0]].values, values, units[chosen], {"channel": chosen}


def _stated_units(path: Path, names: Sequence[str]) -> dict[str, str]:
    """Return the unit of each column as its header writes it: the table knows no units of spectra."""
    # The table has read the whole file, so that it can be decoded.
    lines = (table._decoded(path.read_bytes()) or "").splitlines()
    units = {}
    for name in names:
        pattern = re.compile(re.escape(name) + r"\s*[\[(](.+?)[\])]\s*(?:[,;\t\"]|$)")
        found = next((match for match in map(pattern.search, lines) if match), None)
        if found is None:
            # "PSD/V^2/Hz" and "PSD [V/sqrt(Hz)]" stay whole in the name of the column.
            bracket = _IN_BRACKETS.fullmatch(name)
            units[name] = bracket.group(1) if bracket else name.partition("/")[2]
        else:
            units[name] = found.group(1)
    return {name: text.strip() for name, text in units.items()}


def _from_igor(path: Path, unit: str | None) -> _Parts:
    wave = igor.wave_of(path, path.read_bytes())
    if wave.values.ndim != 1:
        raise FileFormatError(
            f"{path.name} holds no spectrum",
            expected="a one-dimensional wave over frequency",
            got=f"a wave of shape {wave.values.shape}",
            hint="save the density as a wave of its own, scaled in Hz",
        )
    axis = to_si(wave.axis_units[0]) if wave.axis_units[0] else None
    if axis is None or axis[1] != "Hz":
        raise UnitError(
            f"the wave of {path.name} is not scaled in Hz",
            expected="x scaling with the unit Hz",
            got=repr(wave.axis_units[0]),
            hint='SetScale/P x, start, step, "Hz" in Igor, or a table with units in its header',
        )
    frequency = np.asarray(
        (wave.starts[0] + wave.steps[0] * np.arange(wave.values.size)) * axis[0], dtype=float
    )
    stated, attributes = wave.unit, {}
    if asylum.is_asylum(asylum.Settings(asylum.entries_of(wave.note))):
        attributes["vendor"] = "asylum"
        if unit is None and density_factor(stated) is None and stated in _ASYLUM_AMPLITUDE:
            warnings.warn(
                f"{path.name} states the unit {stated!r}, which is none of a spectrum; it was taken for m/rtHz, "
                "which is what Asylum's software writes of thermals. Give unit= where it is another one",
                ChannelWarning,
                stacklevel=3,
            )
            stated = "m/rtHz"
    return frequency, wave.values, stated, attributes


def _from_netcdf(path: Path, channel: str | None) -> _Parts:
    dataset = netcdf.load(path)
    arrays = {str(name): array for name, array in dataset.data_vars.items() if array.dims == ("frequency",)}
    if not arrays or "frequency" not in dataset.coords:
        raise FileFormatError(
            f"{path.name} holds no spectrum",
            expected="a variable over the coordinate frequency",
            got=", ".join(f"{name}{array.dims}" for name, array in dataset.data_vars.items())
            or "no variables",
        )
    units = {name: str(array.attrs.get("units", "")) for name, array in arrays.items()}
    densities = [name for name, text in units.items() if density_factor(text) is not None]
    chosen = _chosen(path, channel, list(arrays), densities or list(arrays)[: len(arrays) == 1], units)
    axis = to_si(str(dataset["frequency"].attrs.get("units", "")))
    if axis is None or axis[1] != "Hz":
        raise UnitError(
            f"the coordinate frequency of {path.name} has no unit of frequency",
            expected="Hz, kHz, ...",
            got=repr(dataset["frequency"].attrs.get("units", "")),
        )
    array = arrays[chosen]
    kept = {
        key: array.attrs[key] for key in ("window", "averages", "vendor") if key in array.attrs
    }  # what `thermal_spectrum` says of how it averaged
    values = array.values.astype(float)
    return (
        dataset["frequency"].values.astype(float) * axis[0],
        values,
        units[chosen],
        {"channel": chosen, **kept},
    )


def _chosen(
    path: Path, channel: str | None, names: Sequence[str], densities: Sequence[str], units: dict[str, str]
) -> str:
    if channel is not None:
        if channel not in names:
            raise ChannelError(f"{path.name} has no {channel!r}", expected=", ".join(names) or "a density")
        return channel
    if not densities:
        raise UnitError(
            f"{path.name} holds no spectral density",
            expected=_FORMS,
            got=", ".join(f"{name} [{units[name]}]" for name in names) or "no column but the frequency",
            hint='unit="V/rtHz" where the file does not say, and channel= where there are several columns',
        )
    if len(densities) > 1:
        raise ChannelError(
            f"{path.name} holds several spectra",
            got=", ".join(densities),
            hint=f"channel={densities[0]!r}",
        )
    return densities[0]
