"""Damage files in many ways, each seeded, and see what becomes of them in processes that can be killed.

Every file is cut short, emptied, renamed, and changed in bytes of its header more often than in its pixels. What
reads it must end in a refusal (an error of overtone's own) or in a recording whose parts agree with one another,
in time, in bounded memory, and without running anything that the file holds.

``python damage.py worker`` is a worker: it takes a mutant a line on its input and answers with a line.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import json
import math
import os
import pickle
import queue
import re
import resource
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

SECONDS = 5.0
"""Longest time to read a file, damaged or not."""
PATIENCE = 40.0
"""After this a worker is killed."""
SLACK, TIMES = 200 << 20, 10
"""Memory: so many bytes and so many times the size of the file."""
SUFFIXES = (
    ".ibw", ".spm", ".000", ".nid", ".jpk", ".h5-jpk", ".tiff", ".gwy", ".gsf", ".h5", ".sxm", ".mdt", ".top",
    ".mi", ".pxp", ".nc", ".csv", ".txt", "",
)  # fmt: skip
_EXTREMES = (
    b"\xff\xff\xff\xff",
    b"\0\0\0\0",
    b"\xff\xff\xff\x7f",
    b"\0\0\0\x80",
    b"\x7f\xff\xff\xff",
    b"\0\0\1\0",
)
_NUMBER = re.compile(rb"\d+")
_TEXT = re.compile(rb"[ -~\r\n\t]{16,}")
_HEADER, _AROUND = 8192, 24


WHOLE = "whole"
"""The kind that is no damage: the file itself, which opens as before after all that was read before it."""


class Mutant(NamedTuple):
    """One damaged file of a source; everything about it follows from these."""

    source: str
    """File or folder, relative to where the files lie; behind :: the wave of an Igor experiment."""
    file: str
    """The file of a folder that is damaged, empty where the source is a file."""
    kind: str
    """cut, flip, rename, empty or whole."""
    number: int
    of: int
    """How many there are of this kind."""


@dataclass(frozen=True)
class Outcome:
    """What became of a mutant."""

    mutant: Mutant
    verdict: str
    """refused, same, changed, or bad."""
    why: str
    """The message of a refusal, or what is bad."""
    seconds: float = 0.0
    memory: float = 0.0
    """Bytes beyond what the process had before."""


# --- mutants ----------------------------------------------------------------------------------------


def mutants(root: Path, source: str, *, cuts: int, flips: int, renames: int) -> list[Mutant]:
    """Return the mutants of a source; of a folder so many of each of its files."""
    place = root / source.partition("::")[0]
    files = [""]
    if place.is_dir():
        files = sorted(file.relative_to(place).as_posix() for file in place.rglob("*") if file.is_file())
    found = []
    for file in files:
        kinds = {"empty": 1, "cut": cuts, "flip": flips, "rename": 0 if file else renames}
        found += [Mutant(source, file, kind, n, of) for kind, of in kinds.items() for n in range(of)]
    return [*found, Mutant(source, "", WHOLE, 0, 1)]


def damaged(content: bytes, mutant: Mutant) -> bytes:
    """Return the content of a mutant."""
    size = len(content)
    if mutant.kind == "empty":
        return b""
    if mutant.kind == "cut":
        return content[: _lengths(size, header_size(content), mutant.of)[mutant.number]]
    if mutant.kind == "flip":
        return _flipped(content, mutant)
    return content


def _lengths(size: int, header: int, number: int) -> list[int]:
    """Return lengths to cut a file to: half in the header, where cuts are of all kinds, half evenly over the file."""
    dense = np.geomspace(1, min(header, size - 1), number // 2).astype(int).tolist()
    even = np.linspace(size - 1, 0, number + 1).astype(int).tolist()
    every = np.linspace(0, size - 1, 9 * number).astype(int).tolist()
    found = list(dict.fromkeys([*dense, *even[::2], *even, *every]))[:number]
    return sorted(found + [size // 2] * (number - len(found)))


def _flipped(content: bytes, mutant: Mutant) -> bytes:
    random = np.random.default_rng(zlib.crc32("|".join(map(str, mutant[:4])).encode()))
    size = len(content)
    changed = bytearray(content)
    header = min(header_size(content), size)
    # Keys and units lie in many places; what stands beside them are the numbers that they name.
    texts = [match.span() for match in _TEXT.finditer(content)] or [(0, header)]
    way = mutant.number % 8

    def somewhere() -> int:
        # Two of five in the header, one beside a text, one in the end, where notes and tables lie, one anywhere.
        where = random.integers(5)
        if where < 2:
            return int(random.integers(header))
        if where == 2:
            start, stop = texts[random.integers(len(texts))]
            return int(np.clip(random.integers(start - _AROUND, stop + _AROUND), 0, size - 1))
        if where == 3:
            return int(random.integers(max(0, size - _HEADER), size))
        return int(random.integers(size))

    if way == 0:
        changed[somewhere()] = random.integers(256)
    elif way == 1:
        changed[somewhere()] ^= 1 << int(random.integers(8))
    elif way == 2:
        for _ in range(4):
            changed[somewhere()] = random.integers(256)
    elif way == 3:  # another number, perhaps of another length, in a text
        start, stop = texts[random.integers(len(texts))]
        found = [match.span() for match in _NUMBER.finditer(content, start, stop)] or [(start, start + 1)]
        start, stop = found[random.integers(len(found))]
        new = (b"0", b"-1", b"1", b"99999999999", b"1e308", b"nan", b"7")[random.integers(7)]
        changed[start:stop] = new if random.integers(2) else new[: stop - start].ljust(stop - start)
    elif way == 4:  # a number of four bytes at one end of its range
        at = somewhere() // 4 * 4
        changed[at : at + 4] = _EXTREMES[random.integers(len(_EXTREMES))]
    elif way == 5:
        for _ in range(16):
            changed[somewhere()] = random.integers(256)
    elif way == 6:  # a hole
        at = somewhere()
        length = int(random.integers(1, 65))
        changed[at : at + length] = bytes(len(changed[at : at + length]))
    else:  # everything behind is one byte early
        del changed[somewhere()]
    return bytes(changed)


def header_size(content: bytes) -> int:
    """Return about how far the part reaches that is not pixels."""
    if content.startswith(b"\\*"):  # NanoScope says how long it is
        return min(8192, content.find(b"\x1a") % (len(content) + 1))
    for mark in (b"#!", b":SCANIT_END:", b"[Header end]", b"\ndata          "):
        end = content.find(mark, 0, 1 << 17)
        if end > 0:
            return end + 32
    if content.startswith(b"\x89HDF"):
        return 60_000
    if content.startswith((b"GWYP", b"Gwyddion")):
        return 512
    if content.startswith((b"MM\0*", b"II*\0")):
        return 15_000
    return min(_HEADER, max(512, len(content) // 16))


# --- one reading, in a worker -----------------------------------------------------------------------


class _Forbidden(BaseException):
    """Something ran that a file has no business to start."""


class _Guard:
    """Watches what Python does while a file is read; what it must not do fails and is remembered."""

    def __init__(self) -> None:
        self.active = False
        self.seen: list[str] = []
        self.allowed = (tempfile.gettempdir(), "/dev/null")
        sys.addaudithook(self._hook)
        for module, name in ((pickle, "load"), (pickle, "loads"), (pickle, "Unpickler"), (os, "system")):
            setattr(module, name, self._refusing(f"{module.__name__}.{name}", getattr(module, name)))

    def _refusing(self, name: str, original: Callable[..., Any]) -> Callable[..., Any]:
        def stand_in(*arguments: Any, **named: Any) -> Any:
            if self.active:
                self._refuse(name)
            return original(*arguments, **named)

        return stand_in

    def _refuse(self, what: str) -> None:
        self.seen.append(what)
        raise _Forbidden(what)

    def _hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.active:
            return
        if event == "exec":
            # Modules are run from their files; a text that is run, by eval too, has no file.
            name = str(getattr(arguments[0], "co_filename", ""))
            if not name.startswith("<frozen") and not Path(name).is_file():
                self._refuse(f"exec of {name}")
        elif event in (
            "pickle.find_class",
            "os.system",
            "os.exec",
            "os.spawn",
            "socket.connect",
            "marshal.load",
        ):
            self._refuse(event)
        elif event == "subprocess.Popen":
            command = [str(part) for part in arguments[1]]
            ours = command[0] == sys.executable and command[1:2] == ["-P"]
            helper = command[0] == "/bin/sh" and any("gwyconvert" in part for part in command)
            if not (ours or helper):
                self._refuse(f"subprocess {command[:3]}")
        elif event == "open":
            path, _, flags = arguments
            writes = isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
            if writes and isinstance(path, str) and not path.startswith(self.allowed):
                self._refuse(f"writing of {path}")


def _size_of_process() -> tuple[int, int]:
    """Return the address space and the resident memory of this process."""
    pages = [int(part) for part in Path("/proc/self/statm").read_text().split()[:2]]
    return pages[0] * resource.getpagesize(), pages[1] * resource.getpagesize()


def _most_resident() -> int:
    match = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    return int(match[1]) * 1024 if match else 0


@contextlib.contextmanager
def _bounded(size: int) -> Iterator[Callable[[], float]]:
    """Bound the memory of this process while a file of a size is read; yields what was taken."""
    space, resident = _size_of_process()
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (space + SLACK + TIMES * size, hard))

    def taken() -> float:
        own = _most_resident() - resident
        most = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
        return max(own, most * 1024 if most > children else 0)

    try:
        yield taken
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (hard, hard))


def _fingerprint(recording: Any) -> str:
    """Return what two recordings of the same data have in common."""
    parts: list[Any] = [recording.format, recording.vendor, recording.dims]
    parts += [(c.name, c.unit, c.direction, c.nap, c.flattened, c.values.shape) for c in recording.channels]
    parts += [sorted((name, fact.value, fact.unit) for name, fact in recording.facts.items())]
    parts += [(r.source, r.frequency, r.quality_factor) for r in recording.resonances]
    digest = hashlib.sha256(repr(parts).encode())
    for values in (
        *(c.values for c in recording.channels),
        *(v for _, v in sorted(recording.coords.items())),
    ):
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def _disagreement(recording: Any) -> str:
    """Return what does not fit together in a recording, empty where everything does."""
    from overtone.io.recording import Recording
    from overtone.io.si import to_si

    if not isinstance(recording, Recording):
        return f"{type(recording).__name__} instead of a recording"
    if not recording.channels:
        return "no channels"
    shapes = {channel.values.shape for channel in recording.channels}
    (shape,) = shapes if len(shapes) == 1 else (None,)
    if shape is None or len(shape) != len(recording.dims) or 0 in shape:
        return f"shapes {shapes} over {recording.dims}"
    for channel in recording.channels:
        if channel.values.dtype != np.float64 or channel.direction not in ("trace", "retrace", None):
            return f"{channel.name}: {channel.values.dtype}, {channel.direction}"
        if not isinstance(channel.name, str) or not channel.name:
            return "a channel without a name"
        if channel.unit is not None and to_si(channel.unit) != (1.0, channel.unit):
            return f"{channel.name}: unit {channel.unit!r}"
    for name, values in recording.coords.items():
        along = shape[recording.dims.index(name)] if name in recording.dims else shape[-1]
        if values.shape != (along,) or not np.isfinite(values).all():
            return f"coordinate {name} of shape {values.shape} for {shape}, or not finite"
    for name, fact in recording.facts.items():
        if not math.isfinite(fact.value) or to_si(fact.unit) is None:
            return f"fact {name}: {fact.value} {fact.unit!r}"
    for resonance in recording.resonances:
        if not (0.0 < resonance.frequency < math.inf and 0.0 < resonance.quality_factor < math.inf):
            return f"resonance {resonance}"
    if not all(isinstance(note, str) for note in recording.notes):
        return "a note that is no text"
    return ""


class _Worker:
    """Reads mutants one after the other, each held against the whole file."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.folder = Path(tempfile.mkdtemp(prefix="damaged-"))
        self.whole: dict[str, str] = {}
        warnings.simplefilter("ignore")
        for library in ("h5netcdf", "h5py", "igor2.binarywave", "igor2.packed", "tifffile", "xarray"):
            importlib.import_module(library)  # damage may lead to another reader than that of the whole file
        self.guard = _Guard()

    def read(self, path: Path | str, size: int, *, guarded: bool = True) -> tuple[str, str, float, float]:
        """Return verdict (refused, opened, bad), what else there is to say, seconds and memory."""
        from overtone.errors import OvertoneError
        from overtone.io.registry import read_channels

        self.guard.seen.clear()
        begun = time.monotonic()
        with _bounded(size) as taken:
            try:
                self.guard.active = guarded
                recording = read_channels(path)
                verdict, why = "opened", ""
            except OvertoneError as error:
                verdict, why = "refused", str(error)
            except BaseException as error:  # that there is none is what is tested
                verdict, why = "bad", f"{type(error).__name__}: {str(error)[:200]}"
            finally:
                self.guard.active = False
            seconds, memory = time.monotonic() - begun, taken()
        if self.guard.seen:
            return "bad", f"ran {self.guard.seen}", seconds, memory
        if verdict == "refused" and ("MemoryError" in why or len(why) > 1500):
            return "bad", f"refused with {why[:300]}", seconds, memory
        if memory > SLACK + TIMES * size:
            return "bad", f"{memory / 1e6:.0f} MB for {size} bytes", seconds, memory
        if verdict == "opened":
            why = _disagreement(recording)
            verdict, why = ("bad", why) if why else ("opened", _fingerprint(recording))
        return verdict, why, seconds, memory

    def outcome(self, mutant: Mutant) -> Outcome:
        """Return what becomes of a mutant."""
        source, mark, wave = mutant.source.partition("::")
        place = self.root / source
        if mutant.source not in self.whole:
            # Libraries make classes from texts while they are imported; when they run again they must not.
            self.read(f"{place}{mark}{wave}", 1 << 30, guarded=False)
            verdict, why, *_ = self.read(f"{place}{mark}{wave}", 1 << 30)
            self.whole[mutant.source] = why if verdict == "opened" else verdict
        original = place / mutant.file if mutant.file else place
        if mutant.kind == WHOLE:
            verdict, why, seconds, memory = self.read(f"{place}{mark}{wave}", 1 << 20)
            as_before = (why if verdict == "opened" else verdict) == self.whole[mutant.source]
            verdict = "bad" if not as_before else "same" if verdict == "opened" else verdict
            return Outcome(mutant, verdict, f"the whole file: {why}", seconds, memory)
        content = damaged(original.read_bytes(), mutant)
        if mutant.file:
            folder = self.folder / place.name
            if not folder.is_dir():
                shutil.copytree(place, folder, copy_function=shutil.copyfile)
                for inner in (folder, *folder.rglob("*")):
                    inner.chmod(0o755)
            target, written = folder, folder / mutant.file
        else:
            target = written = self.folder / f"scan{self._suffix(place, mutant)}"
        written.write_bytes(content)
        try:
            verdict, why, seconds, memory = self.read(f"{target}{mark}{wave}", len(content))
        finally:
            if mutant.file:
                shutil.copyfile(original, written)
            else:
                written.unlink()
        if verdict == "opened":
            verdict, why = ("same" if why == self.whole[mutant.source] else "changed"), ""
        if mutant.kind == "rename" and verdict != (
            "refused" if self.whole[mutant.source] == "refused" else "same"
        ):
            verdict, why = "bad", f"renamed to {target.name} it is {verdict} {why[:200]}"
        return Outcome(mutant, verdict, why, seconds, memory)

    def _suffix(self, place: Path, mutant: Mutant) -> str:
        if mutant.kind != "rename":
            return place.suffix
        others = [suffix for suffix in SUFFIXES if suffix != place.suffix.lower()]
        step = len(others) / mutant.of
        first = zlib.crc32(mutant.source.encode())
        return others[(first + int(mutant.number * step)) % len(others)]


def _serve(root: Path) -> None:
    worker = _Worker(root)
    try:
        for line in sys.stdin:
            outcome = worker.outcome(Mutant(*json.loads(line)))
            print(json.dumps(asdict(outcome) | {"mutant": list(outcome.mutant)}), flush=True)  # noqa: T201
    finally:
        shutil.rmtree(worker.folder, ignore_errors=True)


# --- many readings ----------------------------------------------------------------------------------


class _Process:
    """A worker and its pipes."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._start()

    def _start(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, __file__, "worker", str(self.root)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )

    def ask(self, mutant: Mutant) -> Outcome:
        """Return the outcome of a mutant; a worker that dies or does not answer is started again."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        begun = time.monotonic()
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.write(json.dumps(mutant).encode() + b"\n")
            self.process.stdin.flush()
        line = b""
        while not line.endswith(b"\n"):
            left = begun + PATIENCE - time.monotonic()
            ready = select.select([self.process.stdout], [], [], max(left, 0.0))[0]
            part = os.read(self.process.stdout.fileno(), 1 << 16) if ready else b""
            if not part:
                what = "does not end" if not ready else "ended the process"
                self.close()
                self._start()
                return Outcome(mutant, "bad", what, time.monotonic() - begun)
            line += part
        answer = json.loads(line)
        return Outcome(**answer | {"mutant": Mutant(*answer["mutant"])})

    def close(self) -> None:
        """End the worker and what it started."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.close()
        self.process.stdout.close()
        self.process.wait()


def run(root: Path, wanted: Sequence[Mutant], workers: int = 2) -> list[Outcome]:
    """Return the outcome of every mutant, in the order given; what was slow is read a second time.

    Parameters
    ----------
    root : Path
        Where the sources lie.
    wanted : sequence of Mutant
        The mutants.
    workers : int
        How many processes read at the same time.
    """
    tasks: queue.SimpleQueue[int] = queue.SimpleQueue()
    for index in range(len(wanted)):
        tasks.put(index)
    outcomes: list[Outcome | None] = [None] * len(wanted)

    def work() -> None:
        process = _Process(root)
        try:
            while True:
                try:
                    index = tasks.get_nowait()
                except queue.Empty:
                    return
                outcome = process.ask(wanted[index])
                if outcome.verdict != "bad" and outcome.seconds > SECONDS:
                    outcome = process.ask(wanted[index])  # the machine may have been busy
                    if outcome.verdict != "bad" and outcome.seconds > SECONDS:
                        why = f"{outcome.seconds:.1f} s ({outcome.verdict}: {outcome.why[:200]})"
                        outcome = Outcome(outcome.mutant, "bad", why, outcome.seconds, outcome.memory)
                outcomes[index] = outcome
        finally:
            process.close()

    threads = [threading.Thread(target=work) for _ in range(min(workers, len(wanted)))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return [outcome for outcome in outcomes if outcome is not None]


if __name__ == "__main__":
    _serve(Path(sys.argv[2]))
