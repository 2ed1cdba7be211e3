"""Experiments on a rig: inputs, the loop that records, and the files that keep what was recorded."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import math
import os
import signal
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ftlm.errors import DataError, FtlmError, ModelError, RigFault
from ftlm.files import column_names, load
from ftlm.rig.rig import COLUMNS, CURRENT_LIMIT, LONGEST, Limits, Rig
from ftlm.rig.virtual import ArmParameters, VirtualBoard
from ftlm.runs import Run, build, is_run_name

if TYPE_CHECKING:
    from collections.abc import Callable

    from ftlm.rig.rig import Board, Floats
    from ftlm.streaming import Streaming

__all__ = ["SHAPES", "Excitation", "record"]

SHAPES = ("square", "sine", "chirp", "multisine", "prbs", "doublet", "csv")
INPUTS = ("I1", "I2")
UNITS = {name: "A" if name.startswith("I") else "rad" for name in COLUMNS}
#: The paper's sine [rad/s].
_SINE = 6.3
#: The stock low-pass of the deflections: natural frequency [rad/s] and damping.
STOCK_FILTER = (math.sqrt(157.9137), 22.6195 / (2.0 * math.sqrt(157.9137)))
#: Rows that are handed over at a time. In real time they are few, so that writing them takes less than a sample.
_ROWS_PACED, _ROWS_FAST = 32, 500


@dataclass(frozen=True)
class Excitation:
    """A current for both motors.

    Parameters
    ----------
    shape
        One of SHAPES. ``"square"``: duty one half. ``"sine"``. ``"chirp"``: a sine whose frequency rises exponentially
        over the band. ``"multisine"``: every multiple of 1/period in the band, with equal amplitudes and random phases.
        ``"prbs"``: at random plus or minus, decided anew every `period`. ``"doublet"``: half a period plus, half minus,
        then nothing. ``"csv"``: columns I1 and I2 [A] of a file, held from row to row.
    amplitude
        Largest current [A], of both motors or (stage 1, stage 2).
    period
        [s]; default 2 for square, doublet and multisine (there 10), 2 pi/6.3 for sine, 0.1 for prbs.
    band
        Lowest and highest frequency of chirp and multisine [Hz].
    ramp
        Time over which the amplitude grows from zero [s].
    seed
        Of prbs and multisine; the motors get different ones.
    file
        Of csv.
    """

    shape: str = "square"
    amplitude: float | tuple[float, float] = 0.3
    period: float | None = None
    band: tuple[float, float] = (0.1, 20.0)
    ramp: float = 0.0
    seed: int = 0
    file: str | os.PathLike[str] | None = None

    def commands(self, rate: float, duration: float) -> Floats:
        """Currents [A], shape (round(duration·rate) + 1, 2); the last row is zero.

        Raises
        ------
        ModelError
            A shape, amplitude, period or band that cannot be used; an amplitude over the amplifiers' limit.
        DataError
            A file that cannot be used.
        """
        rows = round(duration * rate) + 1
        t = np.arange(rows) / rate
        if not (isinstance(self.ramp, (int, float)) and 0 <= self.ramp <= duration):
            raise ModelError(f"ramp = {self.ramp!r} s is outside [0, {duration:g}] s, the length of the run")
        if self.shape == "csv":
            found = self._file(t, rate)
        else:
            found = self._shapes(t, rate, duration) * np.array(self._amplitudes())
        if self.ramp > 0:
            found = found * np.minimum(1.0, t / self.ramp)[:, None]
        found[-1] = 0.0
        for k, limit in enumerate(CURRENT_LIMIT):
            over = np.flatnonzero(np.abs(found[:, k]) > limit * (1 + 1e-12))
            if over.size:
                raise ModelError(
                    f"the current of motor {k + 1} is {found[over[0], k]:.4g} A at {t[over[0]]:.4g} s ({over.size} "
                    f"samples in all), over the limit of {limit:g} A; use a smaller amplitude"
                )
        return found

    def _amplitudes(self) -> tuple[float, float]:
        given = self.amplitude if isinstance(self.amplitude, (tuple, list)) else (self.amplitude, self.amplitude)
        if len(given) != 2 or not all(isinstance(a, (int, float)) and math.isfinite(a) and a >= 0 for a in given):
            raise ModelError(f"amplitude = {self.amplitude!r} is not a current in A, or a pair of them")
        for k, (value, limit) in enumerate(zip(given, CURRENT_LIMIT, strict=True)):
            if value > limit:
                raise ModelError(
                    f"amplitude = {value:g} A of motor {k + 1} is over the limit of {limit:g} A; use a smaller one"
                )
        return float(given[0]), float(given[1])

    def _period(self, rate: float) -> float:
        usual = {"sine": 2 * math.pi / _SINE, "prbs": 0.1, "multisine": 10.0}.get(self.shape, 2.0)
        period = usual if self.period is None else self.period
        if not (isinstance(period, (int, float)) and math.isfinite(period) and period * rate >= 2):
            raise ModelError(f"period = {self.period!r} s is not a time of at least two samples ({2 / rate:g} s)")
        return float(period)

    def _shapes(self, t: Floats, rate: float, duration: float) -> Floats:
        period = self._period(rate)
        # Half a sample of slack keeps rounding from moving an edge.
        phase = ((t + 0.5 / rate) % period) / period
        if self.shape == "square":
            one = np.where(phase < 0.5, 1.0, -1.0)
        elif self.shape == "sine":
            one = np.sin(2 * math.pi * t / period)
        elif self.shape == "doublet":
            one = np.where(t + 0.5 / rate < period, np.where(phase < 0.5, 1.0, -1.0), 0.0)
        elif self.shape == "chirp":
            low, high = self._band(rate)
            growth = math.log(high / low)
            one = np.sin(2 * math.pi * low * duration / growth * np.expm1(growth * t / duration))
        elif self.shape in ("prbs", "multisine"):
            return np.column_stack([self._random(t, rate, period, motor) for motor in (0, 1)])
        else:
            raise ModelError(f"input = {self.shape!r} is not known; use one of {', '.join(SHAPES)}")
        return np.column_stack([one, one])

    def _random(self, t: Floats, rate: float, period: float, motor: int) -> Floats:
        rng = np.random.default_rng([self.seed, motor])
        if self.shape == "prbs":
            held = np.floor((t + 0.5 / rate) / period).astype(np.int64)
            return rng.choice([-1.0, 1.0], size=int(held[-1]) + 1)[held]
        low, high = self._band(rate)
        lines = np.arange(math.ceil(low * period - 1e-9), math.floor(high * period + 1e-9) + 1)
        lines = lines[(lines > 0) & (2 * lines <= round(period * rate))]
        if lines.size == 0:
            raise ModelError(f"band = {self.band!r} Hz holds no multiple of 1/period = {1 / period:g} Hz; widen it")
        phases = rng.uniform(0, 2 * math.pi, lines.size)
        n = max(2, round(period * rate))
        spectrum = np.zeros(n // 2 + 1, dtype=np.complex128)
        spectrum[lines] = np.exp(1j * phases)
        one: Floats = np.fft.irfft(spectrum, n)
        one /= np.abs(one).max()
        return one[np.arange(t.size) % n]

    def _band(self, rate: float) -> tuple[float, float]:
        band = self.band
        good = isinstance(band, (tuple, list)) and len(band) == 2 and all(isinstance(b, (int, float)) for b in band)
        if not good or not 0 < band[0] < band[1] <= rate / 2:
            raise ModelError(f"band = {band!r} Hz is not two rising frequencies up to half the rate, {rate / 2:g} Hz")
        return float(band[0]), float(band[1])

    def _file(self, t: Floats, rate: float) -> Floats:
        if self.file is None:
            raise ModelError("input = 'csv' needs a file; give it as file= (--file)")
        names = column_names(self.file)
        currents = [name for name in INPUTS if names is not None and name in names]
        # A run that ftlm wrote knows its signals; any other file is asked for the currents alone.
        run = load(self.file) if names is None else load(self.file, outputs=currents) if currents else None
        if run is None or not any(name in run for name in INPUTS):
            raise DataError(f"{str(self.file)!r} has no column I1 or I2; name the currents [A] so")
        rows = np.minimum(np.floor(t / run.step + 1e-6).astype(np.int64), run.length - 1)
        past = t > run.duration + run.step * (1 - 1e-6)
        given = {name: run[name] for name in INPUTS if name in run}
        zero = np.zeros(run.length)
        found = np.column_stack([given.get(name, zero)[rows] for name in INPUTS])
        found[past] = 0.0
        return found

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        told = asdict(self) | {"file": None if self.file is None else Path(self.file).name}
        return {k: list(v) if isinstance(v, tuple) else v for k, v in told.items() if v is not None}


def partial_of(target: Path) -> Path:
    """Where the rows of a run are until it has ended."""
    return target.with_name(target.stem + ".csv.partial")


class Partial:
    """Rows on disk while they come: a csv file beside the one asked for, which loads should the program die.

    Parameters
    ----------
    target
        The file asked for; None keeps nothing on disk.
    name, step, about
        Of the run.
    """

    def __init__(self, target: Path | None, name: str, step: float, about: dict[str, Any]) -> None:
        self.path = None if target is None else partial_of(target)
        self._step, self._rows = step, 0
        self._descriptor: int | None = None
        if self.path is None:
            return
        header = {
            "name": name, "step": step, "start": 0.0, "inputs": list(INPUTS), "outputs": list(COLUMNS[2:]),
            "units": UNITS, "intersample": dict.fromkeys(INPUTS, "zoh"),
            "warnings": ["the recording did not end: the program died, or the disk was full"],
            "about": about | {"faults": ["the recording did not end"]},
        }  # fmt: skip
        lines = f"# ftlm-run 1 {json.dumps(header, ensure_ascii=False)}\n{','.join(['t_s', *COLUMNS])}\n"
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | getattr(os, "O_BINARY", 0)
        try:
            self._descriptor = os.open(self.path, flags, 0o666)
            self._append(lines.encode())
        except OSError as error:
            self.close()
            reason = error.strerror or error
            raise DataError(
                f"{str(self.path)!r} cannot be written ({reason}); check the folder and the space left"
            ) from None

    def write(self, rows: Floats) -> None:
        """Appends rows, shape (n, 9).

        Raises
        ------
        RigFault
            They cannot be written; whole rows stay.
        """
        if self._descriptor is None or len(rows) == 0:
            self._rows += len(rows)
            return
        t = np.round((self._rows + np.arange(len(rows))) * self._step, 9)
        columns = [map(repr, t.tolist()), *(map(repr, rows[:, k].tolist()) for k in range(len(COLUMNS)))]
        text = "\n".join(map(",".join, zip(*columns, strict=True))) + "\n"
        self._rows += len(rows)
        try:
            self._append(text.encode())
        except OSError as error:
            raise RigFault(f"the recording cannot be written to disk ({error.strerror or error}); make space") from None

    def _append(self, content: bytes) -> None:
        if self._descriptor is None:
            return
        whole = os.lseek(self._descriptor, 0, os.SEEK_END)
        try:
            while content:
                content = content[os.write(self._descriptor, content) :]
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, whole)
            raise

    def close(self) -> None:
        """Closes the file."""
        if self._descriptor is not None:
            with contextlib.suppress(OSError):
                os.close(self._descriptor)
            self._descriptor = None

    def remove(self) -> None:
        """Closes and removes it: the run is in its own file."""
        self.close()
        if self.path is not None:
            with contextlib.suppress(OSError):
                self.path.unlink()


def record(
    rig: str | Board = "virtual",
    *,
    input: str = "square",
    amplitude: float | tuple[float, float] = 0.3,
    period: float | None = None,
    band: tuple[float, float] = (0.1, 20.0),
    ramp: float = 0.0,
    file: str | os.PathLike[str] | None = None,
    duration: float = 10.0,
    limit: float = 30.0,
    rate: float = 500.0,
    seed: int = 0,
    parameters: str | os.PathLike[str] | ArmParameters = "effective",
    paced: bool = False,
    sensor_filter: Literal["stock"] | None = None,
    watchdog: float = 0.1,
    arm: bool = False,
    card: str = "0",
    name: str | None = None,
    out: str | os.PathLike[str] | None = None,
    force: bool = False,
    live: Streaming | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Run:
    """Drive both motors of a rig and record currents and angles.

    Every command is clamped, slew-limited and limited by the motors' heat in the innermost write; every sample is
    checked. However the recording ends, 0 V is written and the amplifiers are disabled, and what was recorded until
    then is kept.

    Parameters
    ----------
    rig : {"virtual", "q8"} or Board, default "virtual"
        The simulated arm, the arm on a Q8-USB board, or a board of your own.
    input : str
        Shape of the current, see `Excitation`: square, sine, chirp, multisine, prbs, doublet or csv.
    amplitude : float or pair of float
        Largest current [A], at most 0.94 and 1.2.
    period : float, optional
        [s]; of a prbs the time between two decisions.
    band : pair of float
        Of chirp and multisine [Hz].
    ramp : float
        Time over which the amplitude grows from zero [s].
    file : path, optional
        Currents for ``input="csv"``, columns I1 and I2 [A].
    duration : float
        [s], above 0 and at most `limit`.
    limit : float
        Longest run that is allowed [s], at most 600.
    rate : float
        Samples per second; the board does up to 8000.
    seed : int
        Of the virtual rig's noise and of random inputs. Equal seeds give equal runs.
    parameters : str, path or ArmParameters
        Of the virtual arm: ``"effective"``, ``"linear"`` (no friction, coupling or noise) or a TOML file.
    paced : bool
        Whether the virtual rig runs in real time.
    sensor_filter : {"stock"}, optional
        Record deflections behind the stock 2 Hz low-pass.
    watchdog : float
        Time after which the watchdog stops the motors [s], 0.01 to 1.
    arm : bool
        Must be True for real hardware: the arm is going to move.
    card : str
        Which Q8-USB, such as ``"0"`` or ``"0@tcpip://host:port"``.
    name : str, optional
        Of the run; default the input's shape.
    out : path, optional
        File to write, .csv or .parquet.
    force : bool
        Whether to overwrite it.
    live : Streaming, optional
        Identification that takes every sample while the run is recorded; the run's `about` says its last estimate.
    progress : callable, optional
        Called with rows recorded and rows in all, after `live` has taken them.

    Returns
    -------
    Run
        I1, I2 [A] as written, held; theta11, theta12, theta21, theta22 [rad] and I1_measured, I2_measured [A]. Its
        `about` says rig, seed, input, parameters, missed deadlines and faults.

    Raises
    ------
    ModelError
        An argument that is out of range, real hardware without ``arm=True``; nothing has moved.
    DataError
        A file that cannot be read, or that is there already; nothing has moved.
    RigFault
        The rig stopped the run. The cause is in words; what was recorded is in `run` and in the file.
    """
    excitation = Excitation(input, amplitude, period, band, ramp, seed, file)
    _check_times(duration, limit, rate, seed)
    commands = excitation.commands(rate, duration)
    if sensor_filter not in (None, "stock"):
        raise ModelError(f"sensor_filter = {sensor_filter!r} is not known; use 'stock' or None")
    board, told = _board(rig, parameters, seed, paced=paced, horizon=limit, card=card)
    paced = paced or board.hardware or bool(getattr(board, "paced", False))
    if board.hardware and not arm:
        raise ModelError(
            f"the {board.name} moves a real arm: clear its workspace, keep the emergency stop at hand, and say so with "
            "arm=True (--arm)"
        )
    name = excitation.shape if name is None else name
    if not is_run_name(name):
        raise DataError(f"name={name!r} cannot name a run")
    target = None if out is None else Path(out)
    if target is not None:
        _check_target(target, force=force)
    about: dict[str, Any] = {
        "rig": board.name, "seed": seed, "rate": rate, "duration": duration, "paced": paced,
        "watchdog": watchdog, "sensor_filter": sensor_filter, "input": excitation.to_dict(), **told,
    }  # fmt: skip
    link = Rig(
        board, rate=rate, watchdog=watchdog, limit=limit, limits=Limits(),
        sensor_filter=STOCK_FILTER if sensor_filter else None,
    )  # fmt: skip
    for needed in () if live is None else live.signals:
        _column(needed)
    partial = Partial(target, name, 1.0 / rate, about)
    recorder = _Recorder(partial, len(commands), progress, live)
    faults: list[str] = []
    ended: BaseException | None = None
    try:
        with link:
            recorder.follow(link, commands, _ROWS_PACED if paced else _ROWS_FAST)
    except RigFault as error:
        ended = error
        faults.append(str(error))
    except (KeyboardInterrupt, SystemExit) as error:
        ended = error
        faults.append(stopped_by(error))
    except BaseException:
        partial.remove()
        raise
    faults += [t for t in link.troubles if t not in faults]
    about |= {"missed_deadlines": link.guard.missed, "faults": faults}
    if live is not None:
        about["live"] = {"coefficients": live.coefficients, "pulses": live.pulses, "trouble": recorder.trouble}
    try:
        run = recorder.finish(name, about, faults, 1.0 / rate)
    except BaseException:
        partial.close()
        raise
    return _saved(run, target, partial, force=force, ended=ended, faults=faults)


def stopped_by(ended: KeyboardInterrupt | SystemExit) -> str:
    """What stopped a run from outside, in words."""
    if isinstance(ended, KeyboardInterrupt):
        return "stopped by Ctrl-C"
    number = ended.code - 128 if isinstance(ended.code, int) else 0
    known = {int(s): s.name for s in signal.Signals}
    return f"stopped by {known.get(number, 'an exit of the program')}"


def _saved(
    run: Run | None,
    target: Path | None,
    partial: Partial,
    *,
    force: bool,
    ended: BaseException | None,
    faults: list[str],
) -> Run:
    """Write the run, and raise what ended it."""
    place = "nothing was recorded until then"
    if run is not None:
        place = f"{run.length} rows were recorded until then"
        if target is not None:
            try:
                save = run.to_csv if target.suffix.lower() == ".csv" else run.to_parquet
                save(target, force=force)
                partial.remove()
                place += f" and are in {target}"
            except DataError as error:
                partial.close()
                fault = RigFault(f"{error}; what was recorded is in {partial.path}")
                if ended is not None:
                    fault = RigFault(f"{'; '.join(faults)}; {place}, in {partial.path}")
                fault.run = run
                raise fault from None
    else:
        partial.remove()
    if isinstance(ended, RigFault) or (ended is None and (faults or run is None)):
        fault = RigFault(f"{'; '.join(faults) or 'no sample was read'}; {place}")
        fault.run = run
        raise fault from None
    if ended is not None:
        raise ended
    if run is None:
        raise RigFault("no sample was read")
    return run


class _Recorder:
    """Takes rows from a rig, to disk and to memory."""

    def __init__(
        self, partial: Partial, rows: int, progress: Callable[[int, int], None] | None, live: Streaming | None
    ) -> None:
        self.partial = partial
        self.live = live
        self.trouble: str | None = None
        self.columns = [] if live is None else [_column(name) for name in live.signals]
        self.blocks: list[Floats] = []
        self.rows, self.done = rows, 0
        self.progress = progress

    def follow(self, rig: Rig, commands: Floats, block: int) -> None:
        """Runs all commands, a block at a time."""
        for start in range(0, len(commands), block):
            try:
                rig.run(commands[start : start + block])
            finally:
                self.keep(rig.take())

    def keep(self, rows: Floats) -> None:
        """Keeps rows in memory first, then on disk."""
        self.blocks.append(rows)
        self.done += len(rows)
        self.partial.write(rows)
        if self.live is not None and self.trouble is None:
            try:
                self.live.push(rows[:, self.columns])
            except FtlmError as error:
                # An estimate that fails is no reason to stop a run that can be identified afterwards.
                self.trouble = str(error)
        if self.progress is not None:
            self.progress(self.done, self.rows)

    def finish(self, name: str, about: dict[str, Any], faults: list[str], step: float) -> Run | None:
        """The run; None if fewer than three rows were recorded."""
        rows = np.concatenate(self.blocks) if self.blocks else np.empty((0, len(COLUMNS) + 1))
        if len(rows) < 3:
            return None
        data = {column: rows[:, k] for k, column in enumerate(COLUMNS)}
        facts = tuple(f"the rig stopped the run after {(len(rows) - 1) * step:.6g} s: {f}" for f in faults)
        return build(
            step=step, time=None, inputs={n: data[n] for n in INPUTS}, outputs={n: data[n] for n in COLUMNS[2:]},
            units=UNITS, intersample=None, name=name, resample=None, window=None, facts=facts, about=about,
        )  # fmt: skip


def _column(name: str) -> int:
    if name not in COLUMNS:
        raise ModelError(f"the live structure needs {name!r}, which a rig does not record; it has {', '.join(COLUMNS)}")
    return COLUMNS.index(name)


def _check_times(duration: float, limit: float, rate: float, seed: int) -> None:
    def number(value: object) -> bool:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)

    if not number(limit) or not 0 < limit <= LONGEST:
        raise ModelError(f"limit = {limit!r} s is outside (0, {LONGEST:g}] s; give the longest time of a run")
    if not number(duration) or duration <= 0:
        raise ModelError(f"duration = {duration!r} s is not a time above 0; give the length of the run")
    if duration > limit:
        way_out = "raise limit= (--limit)" if duration <= LONGEST else f"no run is longer than {LONGEST:g} s"
        raise ModelError(f"duration = {duration:g} s is over the limit of {limit:g} s; {way_out}")
    if not number(rate) or rate <= 0:
        raise ModelError(f"rate = {rate!r} Hz is not a positive number of samples per second")
    if duration * rate < 2:
        raise ModelError(f"duration = {duration:g} s holds fewer than three samples at {rate:g} Hz; make it longer")
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise ModelError(f"seed = {seed!r} is not a whole number from 0")


def _board(
    rig: str | Board, parameters: str | os.PathLike[str] | ArmParameters, seed: int, *, paced: bool, horizon: float,
    card: str,
) -> tuple[Board, dict[str, Any]]:  # fmt: skip
    if rig == "virtual":
        found = ArmParameters.of(parameters)
        board = VirtualBoard(found, seed=seed, paced=paced, horizon=horizon)
        return board, {"parameters": found.to_dict()}
    if rig == "q8":
        from ftlm.rig.quanser import QuanserBoard  # noqa: PLC0415 — the driver is only needed where a board is

        return QuanserBoard(card=card), {"card": card}
    if isinstance(rig, str):
        raise ModelError(f"rig = {rig!r} is not known; use 'virtual' or 'q8'")
    found_parameters = getattr(rig, "parameters", None)
    told = {"parameters": found_parameters.to_dict()} if isinstance(found_parameters, ArmParameters) else {}
    return rig, told


def _check_target(target: Path, *, force: bool) -> None:
    if target.suffix.lower() not in (".csv", ".parquet"):
        raise DataError(f"{str(target)!r} ends with neither .csv nor .parquet; runs are written as one of them")
    if target.suffix.lower() == ".parquet" and importlib.util.find_spec("pyarrow") is None:
        raise DataError(f"{str(target)!r}: parquet needs pyarrow; run: pip install 'ftlm[parquet]'")
    if target.exists() and not force:
        raise DataError(f"{str(target)!r} exists; choose another name, or overwrite it with force=True (--force)")
    if not target.resolve().parent.is_dir():
        raise DataError(f"{str(target.parent)!r} is no folder; make it first")
    left = partial_of(target)
    if left.exists() and not force:
        raise DataError(
            f"{str(left)!r} holds what was recorded by a program that did not end; load it, rename or remove it, or "
            "overwrite it with force=True (--force)"
        )
