"""The probe: tip, cantilever, drive and detector, in SI units, read from and written to TOML."""

from __future__ import annotations

import dataclasses
import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w

from overtone.errors import OvertoneError, ProbeError, UnitError
from overtone.units import display_unit, parse_quantity

DISPLACEMENT = "displacement"
SLOPE = "slope"
TIP = "tip"
BASE = "base"
DYNAMIC = "dynamic"
STATIC = "static"


def _quantity(unit: str, **options: Any) -> Any:
    """Declare a field that carries a unit in TOML and on the command line."""
    return dataclasses.field(metadata={"unit": unit}, **options)


def _require_positive(record: Any, *names: str) -> None:
    """Refuse values that are not finite and positive, naming every one of them."""
    bad = {name: getattr(record, name) for name in names if getattr(record, name) is not None}
    bad = {name: value for name, value in bad.items() if not (math.isfinite(value) and value > 0)}
    if bad:
        got = ", ".join(f"{name} = {value!r}" for name, value in bad.items())
        raise ProbeError(
            f"unphysical {type(record).__name__.lower()}", expected="finite positive numbers", got=got
        )


@dataclasses.dataclass(frozen=True)
class Tip:
    """The end of the tip.

    Parameters
    ----------
    radius : float or None
        Radius of curvature [m]. It has no default: without it no modulus is printed.
    modulus, poisson_ratio : float
        Young's modulus [Pa] and Poisson's ratio of the tip; silicon unless given.
    """

    radius: float | None = _quantity("m", default=None)
    modulus: float = _quantity("Pa", default=130e9)
    poisson_ratio: float = _quantity("1", default=0.3)

    def __post_init__(self) -> None:
        _require_positive(self, "radius", "modulus")
        if not -1.0 < self.poisson_ratio <= 0.5:
            raise ProbeError(
                "unphysical tip", expected="-1 < poisson_ratio <= 0.5", got=str(self.poisson_ratio)
            )


@dataclasses.dataclass(frozen=True)
class Mode:
    """One eigenmode of the cantilever.

    Parameters
    ----------
    stiffness : float
        Modal stiffness k_j at the tip [N/m].
    frequency : float
        Natural frequency [Hz].
    quality_factor : float
        Quality factor, without unit.
    slope_ratio : float
        s_j / s_1: slope at the laser spot per displacement at the tip, relative to the first mode.
        Used only with a detector of kind ``slope``.
    base_participation : float
        Gamma_j: deflection of the tip per motion of the base that enters this mode, from
        ``q_j'' + w_j/Q_j q_j' + w_j^2 q_j = w_j^2/k_j F - Gamma_j y''``; 1 for a point mass on a spring.
        Used only with a drive that moves the base.
    """

    stiffness: float = _quantity("N/m")
    frequency: float = _quantity("Hz")
    quality_factor: float = _quantity("1")
    slope_ratio: float = _quantity("1", default=1.0)
    base_participation: float = _quantity("1", default=1.0)

    def __post_init__(self) -> None:
        _require_positive(self, "stiffness", "frequency", "quality_factor")


@dataclasses.dataclass(frozen=True)
class Cantilever:
    """Eigenmodes of the cantilever, the driven one first.

    Parameters
    ----------
    modes : tuple of Mode
        One mode gives the single-mode receptance of the method's paper.
    static_stiffness : float or None
        Stiffness against a static force at the tip [N/m]. Where given, the modes that are left out
        count with their static share (acceleration form), so that few modes suffice.
    static_slope_ratio : float
        Static slope at the spot per static displacement at the tip, relative to s_1; used only with
        ``static_stiffness`` and a detector of kind ``slope``.
    """

    modes: tuple[Mode, ...]
    static_stiffness: float | None = _quantity("N/m", default=None)
    static_slope_ratio: float = _quantity("1", default=1.0)

    def __post_init__(self) -> None:
        if not self.modes:
            raise ProbeError("a cantilever without modes", expected="at least one mode")
        _require_positive(self, "static_stiffness")

    @classmethod
    def single_mode(cls, stiffness: float, frequency: float, quality_factor: float) -> Cantilever:
        """Return a cantilever of one mode; stiffness [N/m], frequency [Hz]."""
        return cls((Mode(stiffness, frequency, quality_factor),))


@dataclasses.dataclass(frozen=True)
class Drive:
    """The excitation, described by what it does far from the sample.

    Parameters
    ----------
    frequency : float
        Drive frequency [Hz].
    free_amplitude : float
        Amplitude A1far of the first harmonic far from the sample [m], as the detector reads it.
    acts_on : str
        ``tip`` (a force at the tip, as magnetic or photothermal drives nearly are) or ``base`` (a piezo
        shakes the base, which moves the tip too). Far above Q = 1 both give the same motion.
    """

    frequency: float = _quantity("Hz")
    free_amplitude: float = _quantity("m")
    acts_on: str = TIP

    def __post_init__(self) -> None:
        _require_positive(self, "frequency", "free_amplitude")
        if self.acts_on not in (TIP, BASE):
            raise ProbeError("unknown drive", expected=f"{TIP!r} or {BASE!r}", got=repr(self.acts_on))


@dataclasses.dataclass(frozen=True)
class Detector:
    """What the deflection signal measures.

    Parameters
    ----------
    kind : str
        ``displacement`` (interferometer; every mode counts alike) or ``slope`` (optical lever;
        each mode counts with its slope at the spot). Both are calibrated on the first mode.
    mean_sensitivity : str
        With which sensitivity the mean deflection was turned into a length: ``dynamic``, that of the first mode,
        as the amplitudes, or ``static``, that of a force curve on a hard surface, which for a slope detector is
        smaller by the `Cantilever.static_slope_ratio` (1.09 for a uniform beam). Confusing them costs 9 % of A0.
    """

    kind: str = DISPLACEMENT
    mean_sensitivity: str = DYNAMIC

    def __post_init__(self) -> None:
        if self.kind not in (DISPLACEMENT, SLOPE):
            raise ProbeError(
                "unknown detector", expected=f"{DISPLACEMENT!r} or {SLOPE!r}", got=repr(self.kind)
            )
        if self.mean_sensitivity not in (DYNAMIC, STATIC):
            raise ProbeError(
                "unknown sensitivity of the mean deflection",
                expected=f"{DYNAMIC!r} or {STATIC!r}",
                got=repr(self.mean_sensitivity),
            )


@dataclasses.dataclass(frozen=True)
class Probe:
    """Tip, cantilever, drive and detector together."""

    cantilever: Cantilever
    drive: Drive
    tip: Tip = Tip()
    detector: Detector = Detector()

    @classmethod
    def simple(
        cls,
        *,
        stiffness: float,
        frequency: float,
        quality_factor: float,
        drive_frequency: float,
        free_amplitude: float,
        radius: float | None = None,
        tip_modulus: float = 130e9,
        tip_poisson_ratio: float = 0.3,
    ) -> Probe:
        """Return a single-mode probe read as displacement, the probe of the method's paper.

        Parameters
        ----------
        stiffness, frequency, quality_factor : float
            k_far [N/m], f_far [Hz] and Q_far of the driven mode.
        drive_frequency, free_amplitude : float
            Drive frequency [Hz] and A1far [m].
        radius, tip_modulus, tip_poisson_ratio : float
            Tip radius [m], modulus [Pa] and Poisson's ratio.

        Raises
        ------
        ProbeError
            If a value is not finite and positive.

        Examples
        --------
        >>> probe = Probe.simple(stiffness=16.4, frequency=161.8e3, quality_factor=287, radius=10e-9,
        ...                      drive_frequency=161.8e3, free_amplitude=94e-9)
        >>> probe.drive_ratio
        1.0
        """
        return cls(
            cantilever=Cantilever.single_mode(stiffness, frequency, quality_factor),
            drive=Drive(drive_frequency, free_amplitude),
            tip=Tip(radius, tip_modulus, tip_poisson_ratio),
        )

    @property
    def drive_ratio(self) -> float:
        """r = f_drive / f_1."""
        return self.drive.frequency / self.cantilever.modes[0].frequency


def required_radius(probe: Probe) -> float:
    """Return the tip radius, or say that it is missing.

    Raises
    ------
    ProbeError
        If the probe has none.
    """
    if probe.tip.radius is None:
        raise ProbeError(
            "no tip radius",
            expected="the radius of the tip, which scales every modulus as 1/sqrt(R)",
            hint='radius = "10 nm" in the [tip] section of the probe, or --radius "10 nm"',
        )
    return probe.tip.radius


_SECTIONS = {"tip": Tip, "drive": Drive, "detector": Detector}


def load_probe(path: str | Path) -> Probe:
    """Read a probe from a TOML file whose quantities carry units.

    Parameters
    ----------
    path : str or Path
        A file as written by `save_probe`, or one whose section ``[cantilever.beam]`` gives ``stiffness``,
        ``frequency``, ``quality_factor``, ``tip_position``, ``tip_mass`` and ``spot_position`` in place of modes
        (see `overtone.beam_modes`).

    Raises
    ------
    ProbeError
        If the file is missing, is not TOML, or lacks or misstates a quantity. Every fault is named.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ProbeError(
            f"cannot read the probe file {path}", got=str(error), hint="check the path"
        ) from error
    return parse_probe(text, source=path.name)


def parse_probe(text: str, source: str = "probe") -> Probe:
    """Read a probe from TOML text.

    Raises
    ------
    ProbeError
        If the text is not TOML, or lacks or misstates a quantity. Every fault is named.

    Examples
    --------
    >>> probe = parse_probe('''
    ... cantilever = {stiffness = "16.4 N/m", frequency = "161.8 kHz", quality_factor = 287}
    ... drive = {frequency = "161.8 kHz", free_amplitude = "94 nm"}
    ... tip = {radius = "10 nm"}
    ... ''')
    >>> probe.cantilever.modes[0].stiffness
    16.4
    """
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ProbeError(f"{source} is not TOML", got=str(error)) from error
    faults: list[str] = []
    unknown = set(table) - {*_SECTIONS, "cantilever"}
    faults += [f"unknown section [{name}]" for name in sorted(unknown)]
    cantilever = _parse_cantilever(table.get("cantilever"), faults)
    parts = {name: _parse_record(kind, table.get(name, {}), name, faults) for name, kind in _SECTIONS.items()}
    if faults or cantilever is None:
        raise ProbeError(
            f"{source} does not describe a probe",
            got="; ".join(faults),
            hint="sections [cantilever] (stiffness, frequency, quality_factor), [drive] (frequency, "
            'free_amplitude), [tip] (radius), with units as in stiffness = "16.4 N/m"',
        )
    return Probe(cantilever=cantilever, **parts)


def _parse_cantilever(table: Any, faults: list[str]) -> Cantilever | None:
    if not isinstance(table, Mapping):
        faults.append("no section [cantilever]")
        return None
    if "beam" in table:
        if len(table) > 1:
            faults.append("[cantilever] must give either a beam or modes, not both")
            return None
        return _parse_beam(table["beam"], faults)
    own = {"static_stiffness", "static_slope_ratio"}
    extra = {name: value for name, value in table.items() if name in own}
    single = {name: value for name, value in table.items() if name not in own | {"modes"}}
    entries = table.get("modes")
    if entries is None:
        entries = [single]
    elif single or not isinstance(entries, list):
        faults.append("[cantilever] must give either one mode or a list [[cantilever.modes]], not both")
        return None
    modes = [
        _parse_record(Mode, entry, f"cantilever mode {i + 1}", faults) for i, entry in enumerate(entries)
    ]
    if faults or any(mode is None for mode in modes):
        return None
    try:
        values = {name: parse_quantity(value, _unit(Cantilever, name), name) for name, value in extra.items()}
        return Cantilever(tuple(modes), **values)
    except OvertoneError as error:
        faults.append(str(error))
        return None


_BEAM_UNITS = {"frequency": "Hz", "stiffness": "N/m", "static_stiffness": "N/m"} | dict.fromkeys(
    ("quality_factor", "tip_position", "tip_mass", "spot_position"), "1"
)


def _parse_beam(table: Any, faults: list[str]) -> Cantilever | None:
    """Return the modes of a uniform beam from what was measured of it, tip and laser spot included."""
    from overtone.beam import beam_modes  # needs this module

    if not isinstance(table, Mapping):
        faults.append("[cantilever.beam] is not a table")
        return None
    before = len(faults)
    faults += [f"[cantilever.beam] has no quantity {name!r}" for name in table if name not in _BEAM_UNITS]
    needed = ("frequency", "quality_factor")
    faults += [f"[cantilever.beam] lacks {name}" for name in needed if name not in table]
    values: dict[str, Any] = {}
    for name, unit in _BEAM_UNITS.items():
        try:
            if name in table:
                values[name] = parse_quantity(table[name], unit, f"cantilever.beam.{name}")
        except UnitError as error:
            faults.append(str(error))
    if len(faults) > before:
        return None
    try:
        return beam_modes(**values)
    except OvertoneError as error:
        faults.append(str(error))
        return None


def _unit(kind: type, name: str) -> str:
    fields = {field.name: field for field in dataclasses.fields(kind)}
    return str(fields[name].metadata["unit"])


def _parse_record(kind: Any, table: Any, section: str, faults: list[str]) -> Any:
    """Build a record from a TOML table; on failure return None and add every fault to the list."""
    if not isinstance(table, Mapping):
        faults.append(f"[{section}] is not a table")
        return None
    fields = {field.name: field for field in dataclasses.fields(kind)}
    before = len(faults)
    faults += [f"[{section}] has no quantity {name!r}" for name in table if name not in fields]
    values: dict[str, Any] = {}
    for name, field in fields.items():
        if name not in table:
            if field.default is dataclasses.MISSING:
                faults.append(f"[{section}] lacks {name}")
            continue
        unit = field.metadata.get("unit")
        try:
            values[name] = parse_quantity(table[name], unit, f"{section}.{name}") if unit else table[name]
        except UnitError as error:
            faults.append(str(error))
    if len(faults) > before:
        return None
    try:
        return kind(**values)
    except OvertoneError as error:
        faults.append(str(error))
        return None


def _with_unit(value: float, unit: str) -> str | float:
    """Write a value so that reading it back gives the same float, in a readable unit if it can be."""
    if unit == "1":
        return value
    display = display_unit(value, unit)
    for digits in range(1, 18):
        text = f"{float(f'{value * display.factor:.{digits}g}')!r} {display.label}"
        if parse_quantity(text, unit) == value:
            return text
    return f"{value!r} {unit}"


def format_probe(probe: Probe) -> str:
    """Write a probe as TOML text that `parse_probe` reads back to the same floats."""

    def table(record: Any) -> dict[str, Any]:
        values = ((field, getattr(record, field.name)) for field in dataclasses.fields(record))
        return {
            field.name: _with_unit(value, field.metadata["unit"]) if "unit" in field.metadata else value
            for field, value in values
            if value is not None and field.name != "modes"
        }

    cantilever = table(probe.cantilever)
    modes = [table(mode) for mode in probe.cantilever.modes]
    if probe.cantilever.static_stiffness is None:
        cantilever = {}
    cantilever |= modes[0] if len(modes) == 1 else {"modes": modes}
    sections = {name: table(getattr(probe, name)) for name in _SECTIONS}
    return tomli_w.dumps({"cantilever": cantilever, **sections})


def save_probe(probe: Probe, path: str | Path) -> None:
    """Write a probe to a TOML file, quantities with units."""
    Path(path).write_text(format_probe(probe), encoding="utf-8")
