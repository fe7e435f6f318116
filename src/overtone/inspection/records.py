"""What an inspection of a file says, as records: tables and sentences, nothing printed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

YES, IF, NO = "yes", "yes, with", "no"
"""Answers of a verdict: as the file is; once what it lacks is given; whatever is given."""


@dataclass(frozen=True)
class ChannelRow:
    """One channel in numbers.

    Parameters
    ----------
    name : str
        As in the file.
    unit : str or None
        SI unit, None where the file states none.
    direction : str or None
        Line direction where the file says so.
    used_as : str
        Observable that it is taken for, such as ``A1``; empty where it is not used.
    mean, low, high : float
        Of its valid pixels [unit]; NaN where there are none.
    remark : str
        Nap pass, flattened, invalid pixels, saturated, why it is not used.
    """

    name: str
    unit: str | None
    direction: str | None
    used_as: str
    mean: float
    low: float
    high: float
    remark: str


@dataclass(frozen=True)
class SettingRow:
    """One setting of the instrument.

    Parameters
    ----------
    name : str
        What it is, in words.
    text : str
        Its value with a readable unit.
    key : str
        Where the file says so.
    remark : str
        Such as "factory default".
    """

    name: str
    text: str
    key: str
    remark: str


@dataclass(frozen=True)
class PropertyRow:
    """One map of a result of overtone, over the pixels where it has a value.

    Parameters
    ----------
    name, meaning : str
        Name of the variable, and in words.
    unit : str
        SI unit.
    median, low, high : float
        Median, 5th and 95th percentile [unit]; NaN where no pixel has a value.
    lower, upper : float
        Medians of the ends of the 90 % interval [unit], NaN where there is none.
    share : float
        Share of pixels with a value.
    """

    name: str
    meaning: str
    unit: str
    median: float
    low: float
    high: float
    lower: float
    upper: float
    share: float


@dataclass(frozen=True)
class Missing:
    """What a purpose needs and the file does not give.

    Parameters
    ----------
    purpose : str
        What it is needed for.
    what : str
        The thing that is missing.
    remark : str
        What the file has in its place, empty where it has nothing.
    """

    purpose: str
    what: str
    remark: str


@dataclass(frozen=True)
class Ask:
    """Something to ask the operator for, or to do at the microscope next time.

    Parameters
    ----------
    sentence : str
        What, and why.
    option : str
        The option that passes it, such as ``--direction trace``; empty where none does.
    later : bool
        Whether it takes another measurement.
    """

    sentence: str
    option: str = ""
    later: bool = False


@dataclass(frozen=True)
class Verdict:
    """Whether the data can give one thing.

    Parameters
    ----------
    question : str
        What is asked.
    answer : str
        ``yes``, ``yes, with`` or ``no``.
    lacking : tuple of str
        What it takes where the answer is ``yes, with``.
    reason : str
        Why, as a sentence.
    """

    question: str
    answer: str
    lacking: tuple[str, ...]
    reason: str

    def sentence(self) -> str:
        """Return question, answer and reason in one line."""
        answer = f"{self.answer} {listed(self.lacking)}" if self.lacking else self.answer
        return f"{self.question}: {answer}. {self.reason}".strip()


@dataclass(frozen=True)
class Inspection:
    """Everything there is to say of a file; see `overtone.inspect_scan`.

    Parameters
    ----------
    path : Path
        The file.
    kind : str
        ``scan``, ``video``, ``curve``, ``points`` or ``result``.
    format : str
        Format of the file, in words.
    headline : str
        What was found, in one sentence.
    channels : tuple of ChannelRow
        In the order of the file; of a result empty.
    settings : tuple of SettingRow
        What the file says of the instrument.
    missing : tuple of Missing
        What is missing, for which purpose.
    asks : tuple of Ask
        What to ask for or to do, the most important first.
    verdicts : tuple of Verdict
        What these data can give.
    remarks : tuple of str
        What was noticed in the file.
    probe_file : str
        Probe file to complete, with what the file knows; empty where none is asked for.
    properties : tuple of PropertyRow
        Of a result, its maps.
    made_by : tuple of str
        Of a result, how it was made, step by step.
    """

    path: Path
    kind: str
    format: str
    headline: str
    channels: tuple[ChannelRow, ...] = ()
    settings: tuple[SettingRow, ...] = ()
    missing: tuple[Missing, ...] = ()
    asks: tuple[Ask, ...] = ()
    verdicts: tuple[Verdict, ...] = ()
    remarks: tuple[str, ...] = ()
    probe_file: str = ""
    properties: tuple[PropertyRow, ...] = field(default=())
    made_by: tuple[str, ...] = field(default=())


def listed(words: Sequence[str]) -> str:
    """Return words as a list of prose.

    Examples
    --------
    >>> listed(["k"]), listed(["k", "f0 and Q", "A0"])
    ('k', 'k, f0 and Q and A0')
    """
    return words[0] if len(words) == 1 else ", ".join(words[:-1]) + " and " + words[-1]


def as_sentence(text: str) -> str:
    """Return a text as a sentence: with a capital letter, unless it begins with a name, and a full stop.

    Examples
    --------
    >>> as_sentence("the file holds both"), as_sentence("M1A: no unit"), as_sentence("overtone map says it.")
    ('The file holds both.', 'M1A: no unit.', 'overtone map says it.')
    """
    text = text.strip()
    first = text.split(maxsplit=1)[0] if text else ""
    if first.isalpha() and first.islower() and first != "overtone":
        text = text[0].upper() + text[1:]
    return text if not text or text.endswith((".", "?", "!")) else f"{text}."
