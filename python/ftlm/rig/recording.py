"""The file that keeps what an experiment has recorded so far."""

from __future__ import annotations

import contextlib
import importlib.util
import math
import os
import signal
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from ftlm.data.construction import Asked
from ftlm.data.export import Header
from ftlm.data.run import Run, built
from ftlm.errors import DataError, FtlmError, ModelError, RigFault
from ftlm.estimation.linear import Streaming
from ftlm.rig.arm_parameters import ArmParameters
from ftlm.rig.excitation import INPUTS, Excitation, finite
from ftlm.rig.quanser import QuanserBoard
from ftlm.rig.rig import COLUMNS, LONGEST, Board, Limits, Rig
from ftlm.rig.virtual_board import VirtualBoard
from ftlm.utils.files import RUN, check_free
from ftlm.utils.validation import CSV_TIME, Floats, check_choice, check_seed, is_run_name, shown

UNITS = {name: "A" if name.startswith("I") else "rad" for name in COLUMNS}


def units_of(told: tuple[str, ...] = ()) -> dict[str, str]:
    """Units of a run's columns; what a run tells besides are angles."""
    return UNITS | dict.fromkeys(told, "rad")


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
    told
        Names of its further inputs, which follow the rig's columns in every row.
    """

    def __init__(
        self, target: Path | None, name: str, step: float, about: dict[str, Any], told: tuple[str, ...] = ()
    ) -> None:
        self.path = None if target is None else partial_of(target)
        self._step, self._rows = step, 0
        self._columns = (*COLUMNS, *told)
        #: Rows that are on disk, whole.
        self.kept = 0
        self._descriptor: int | None = None
        if self.path is None:
            return
        inputs = (*INPUTS, *told)
        header = Header(
            name,
            step,
            0.0,
            inputs,
            tuple(COLUMNS[2:]),
            units_of(told),
            dict.fromkeys(inputs, "zoh"),
            ("the recording did not end: the program died, or the disk was full",),
            about | {"faults": ["the recording did not end"]},
        )
        lines = f"{header.line()}{','.join([CSV_TIME, *self._columns])}\n"
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
        try:
            # Whoever overwrites a link means the link, not what it leads to.
            self.path.unlink(missing_ok=True)
            self._descriptor = os.open(self.path, flags, 0o666)
            self._append(lines.encode())
        except OSError as error:
            self.close()
            reason = error.strerror or error
            raise DataError(
                f"{str(self.path)!r} cannot be written ({reason}); check the folder and the space left"
            ) from None

    def write(self, rows: Floats) -> None:
        """Appends rows, shape (n, columns).

        Raises
        ------
        RigFault
            They cannot be written; whole rows stay.
        """
        if self._descriptor is None or len(rows) == 0:
            self._rows += len(rows)
            return
        t = np.round((self._rows + np.arange(len(rows))) * self._step, 9)
        columns = [map(repr, t.tolist()), *(map(repr, rows[:, k].tolist()) for k in range(len(self._columns)))]
        text = "\n".join(map(",".join, zip(*columns, strict=True))) + "\n"
        self._rows += len(rows)
        try:
            self._append(text.encode())
            self.kept += len(rows)
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


def saved(
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
                place += f"; {partial.kept} of them are in {partial.path}"
                fault = RigFault(f"{error}; {place}")
                if ended is not None:
                    fault = RigFault(f"{'; '.join(faults)}; {place}")
                fault.run = run
                raise fault from None
    else:
        partial.remove()
    if ended is not None and not isinstance(ended, RigFault):
        raise ended
    if ended is not None or faults or run is None:
        fault = RigFault(f"{'; '.join(faults) or 'no sample was read'}; {place}")
        fault.run = run
        # What made a controller fail is its own to show.
        raise fault from (None if ended is None else ended.__cause__)
    return run


#: The stock low-pass of the deflections: natural frequency [rad/s] and damping.
STOCK_FILTER = (math.sqrt(157.9137), 22.6195 / (2.0 * math.sqrt(157.9137)))
#: Rows that are handed over at a time. In real time they are few, so that writing them takes less than a sample.
_ROWS_PACED, _ROWS_FAST = 32, 500


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
    offset: tuple[float, float] | None = None,
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
        Of the virtual arm: ``"effective"``, ``"measured"``, ``"linear"`` (no friction, coupling or noise), a TOML file.
    offset : pair of float, optional
        What drives each motor of the virtual arm besides its command while the amplifiers are enabled [A]; default that
        of its parameters, 0. It belongs to a run: real ones have another each.
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
    BaseException
        Ctrl-C, SIGTERM, or what `progress` raised, after the way out and when what was recorded is in the file; its
        notes say what went wrong on the way out.
    """
    seed = check_seed(seed)
    duration, limit, rate = check_times(duration, limit, rate)
    excitation = Excitation(input, amplitude, period, band, ramp, seed, file)
    commands = excitation.commands(rate, duration)
    asked = Experiment(
        rig,
        duration,
        limit,
        rate,
        seed,
        parameters,
        offset,
        paced,
        sensor_filter,
        watchdog,
        arm,
        card,
        excitation.shape if name is None else name,
        out,
        force,
        live,
        progress,
    )
    return asked.recorded(lambda board: Given(commands), {"input": excitation.to_dict()})


class Source(Protocol):
    """What asks for commands while a run is recorded."""

    rows: int
    #: Further columns of the run by name, a row for each of its samples.
    told: dict[str, Floats]

    def first(self, rig: Rig, block: int) -> Floats:
        """The first commands, shape (n, 2) [A]; at most `block` of them where none depends on a measurement."""

    def after(self, rows: Floats) -> Floats:
        """The next commands when these rows have been measured; none when the run is over."""

    def blamed(self, fault: str) -> str:
        """A fault of the rig in words, with what the source has to do with it."""


@dataclass(frozen=True)
class Experiment:
    """What a run is asked with; see :func:`record`."""

    rig: str | Board
    duration: float
    limit: float
    rate: float
    seed: int
    parameters: str | os.PathLike[str] | ArmParameters
    offset: tuple[float, float] | None
    paced: bool
    sensor_filter: Literal["stock"] | None
    watchdog: float
    arm: bool
    card: str
    name: str
    out: str | os.PathLike[str] | None
    force: bool
    live: Streaming | None
    progress: Callable[[int, int], None] | None

    def recorded(self, source_on: Callable[[Board], Source], told: dict[str, Any]) -> Run:
        """Drive the rig as a source on its board asks, and record it."""
        # What moves an arm is no matter of what Python takes for true.
        for name, flag in (("paced", self.paced), ("arm", self.arm), ("force", self.force)):
            if not isinstance(flag, bool):
                raise ModelError(f"{name} = {shown(flag)} is neither True nor False; use one of them")
        if self.progress is not None and not callable(self.progress):
            raise ModelError(f"progress is a {type(self.progress).__name__}; pass what is called with (done, all)")
        if self.sensor_filter is not None and not (
            isinstance(self.sensor_filter, str) and self.sensor_filter == "stock"
        ):
            raise ModelError(f"sensor_filter = {shown(self.sensor_filter)} is not known; use 'stock' or None")
        board, known = _board(
            self.rig, self.parameters, self.seed, self.offset, paced=self.paced, horizon=self.limit, card=self.card
        )
        paced = self.paced or board.hardware or bool(getattr(board, "paced", False))
        if board.hardware and not self.arm:
            raise ModelError(
                f"the {board.name} moves a real arm: clear its workspace, keep the emergency stop at hand, and say so "
                "with arm=True (--arm)"
            )
        if not is_run_name(self.name):
            raise DataError(f"name={shown(self.name)} cannot name a run")
        target = None if self.out is None else Path(self.out)
        if target is not None:
            _check_target(target, force=self.force)
        source = source_on(board)
        about: dict[str, Any] = {
            "rig": board.name,
            "seed": self.seed,
            "rate": self.rate,
            "duration": self.duration,
            "paced": paced,
            "watchdog": self.watchdog,
            "sensor_filter": self.sensor_filter,
            **told,
            **known,
        }
        link = Rig(
            board,
            rate=self.rate,
            watchdog=self.watchdog,
            limit=self.limit,
            limits=Limits(),
            sensor_filter=STOCK_FILTER if self.sensor_filter else None,
        )
        step, live = 1.0 / self.rate, self.live
        columns = [] if live is None else [_column_of(signal_name) for signal_name in live.signals]
        partial = Partial(target, self.name, step, about, tuple(source.told))
        recorder = _Recorder(partial, source, self.progress, live, columns, _ROWS_PACED if paced else _ROWS_FAST)
        ended, faults = _drive(link, recorder)
        about |= {"missed_deadlines": link.guard.missed, "faults": faults}
        if live is not None:
            about["live"] = {"coefficients": live.coefficients, "pulses": live.pulses, "trouble": recorder.trouble}
        try:
            run = recorder.finish(self.name, about, faults, step)
            return saved(run, target, recorder.partial, force=self.force, ended=ended, faults=faults)
        except BaseException:
            recorder.partial.close()
            raise


class Given:
    """Commands that are known before the run, shape (rows, 2) [A]."""

    def __init__(self, commands: Floats) -> None:
        self.commands, self.rows = commands, len(commands)
        self.told: dict[str, Floats] = {}
        self._at = self._block = 0

    def first(self, rig: Rig, block: int) -> Floats:
        """The first block."""
        self._at, self._block = block, block
        return self.commands[:block]

    def after(self, rows: Floats) -> Floats:
        """The next block, whatever was measured."""
        start, self._at = self._at, self._at + self._block
        return self.commands[start : start + self._block]

    def blamed(self, fault: str) -> str:
        """The fault: commands that were known beforehand have nothing to do with it."""
        return fault


def _drive(link: Rig, recorder: _Recorder) -> tuple[BaseException | None, list[str]]:
    """Runs all commands between a start and a way out; what ended the run early, and every fault in words."""
    faults: list[str] = []
    ended: BaseException | None = None
    try:
        with link:
            recorder.follow(link)
    except RigFault as error:
        ended = error
        faults.append(recorder.source.blamed(str(error)))
    except (KeyboardInterrupt, SystemExit) as error:
        ended = error
        faults.append(recorder.source.blamed(stopped_by(error)))
    except BaseException as error:
        # Of the program, such as one in `progress`: it is raised when what was recorded is in its file.
        ended = error
        faults.append(f"stopped by an error of the program ({type(error).__name__}: {error})")
    if ended is not None and not isinstance(ended, RigFault):
        for trouble in link.troubles:
            ended.add_note(trouble)
    return ended, faults + [t for t in link.troubles if t not in faults]


def stopped_by(ended: KeyboardInterrupt | SystemExit) -> str:
    """What stopped a run from outside, in words."""
    if isinstance(ended, KeyboardInterrupt):
        return "stopped by Ctrl-C"
    number = ended.code - 128 if isinstance(ended.code, int) else 0
    known = {int(s): s.name for s in signal.Signals}
    return f"stopped by {known.get(number, 'an exit of the program')}"


class _Recorder:
    """Takes rows from a rig, to disk and to memory."""

    def __init__(
        self,
        partial: Partial,
        source: Source,
        progress: Callable[[int, int], None] | None,
        live: Streaming | None,
        columns: list[int],
        block: int,
    ) -> None:
        self.partial, self.source, self.progress = partial, source, progress
        self.live, self.columns, self.block = live, columns, block
        self.trouble: str | None = None
        self.blocks: list[Floats] = []
        self.waiting: list[Floats] = []
        self.done = 0

    def follow(self, rig: Rig) -> None:
        """Runs all that the source asks for; rows are kept a block at a time."""
        try:
            commands = self.source.first(rig, self.block)
            while len(commands):
                try:
                    rig.run(commands)
                finally:
                    rows = rig.take()
                    self.waiting.append(rows)
                if sum(map(len, self.waiting)) >= self.block:
                    self.flush()
                commands = self.source.after(rows)
        finally:
            self.flush()

    def flush(self) -> None:
        """Keeps the rows that wait."""
        rows, self.waiting = np.concatenate([np.empty((0, len(COLUMNS) + 1)), *self.waiting]), []
        if len(rows):
            self.keep(rows)

    def keep(self, rows: Floats) -> None:
        """Keeps rows in memory first, then on disk."""
        told = [values[self.done : self.done + len(rows), None] for values in self.source.told.values()]
        rows = np.hstack([rows[:, : len(COLUMNS)], *told])
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
            self.progress(self.done, self.source.rows)

    def finish(self, name: str, about: dict[str, Any], faults: list[str], step: float) -> Run | None:
        """The run; None if fewer than three rows were recorded."""
        told = tuple(self.source.told)
        rows = np.concatenate(self.blocks) if self.blocks else np.empty((0, len(COLUMNS) + len(told)))
        if len(rows) < 3:
            return None
        data = {column: rows[:, k] for k, column in enumerate((*COLUMNS, *told))}
        facts = tuple(f"the rig stopped the run after {(len(rows) - 1) * step:.6g} s: {f}" for f in faults)
        signals = {n: data[n] for n in (*INPUTS, *told)}, {n: data[n] for n in COLUMNS[2:]}
        return built(Asked(*signals, step=step, units=units_of(told), name=name, facts=facts, about=about))


def _board(
    rig: str | Board,
    parameters: str | os.PathLike[str] | ArmParameters,
    seed: int,
    offset: tuple[float, float] | None,
    *,
    paced: bool,
    horizon: float,
    card: str,
) -> tuple[Board, dict[str, Any]]:
    """The board that is asked for, and what a run tells of it."""
    virtual = isinstance(rig, str) and rig == "virtual"
    if offset is not None and not virtual:
        raise ModelError("offset is of the virtual arm; a board has its own, leave it out")
    if virtual:
        arm = ArmParameters.of(parameters)
        if offset is not None:
            try:
                first, second = (float(v) for v in offset)
            except (TypeError, ValueError, OverflowError):
                first = second = math.nan
            if isinstance(offset, str) or not (math.isfinite(first) and math.isfinite(second)):
                raise ModelError(f"offset = {shown(offset)} is not a pair of currents [A], of motor 1 and motor 2")
            arm = replace(arm, current_offset=(first, second))
        return VirtualBoard(arm, seed=seed, paced=paced, horizon=horizon), {"parameters": arm.to_dict()}
    if isinstance(rig, str):
        check_choice("rig", rig, ("virtual", "q8"))
        return QuanserBoard(card=card), {"card": card}
    if not hasattr(rig, "hardware"):
        raise ModelError(f"rig is a {type(rig).__name__}; use 'virtual', 'q8' or a board of your own")
    own = getattr(rig, "parameters", None)
    return rig, {"parameters": own.to_dict()} if isinstance(own, ArmParameters) else {}


def _check_target(target: Path, *, force: bool) -> None:
    if target.suffix.lower() not in (".csv", ".parquet"):
        raise DataError(f"{str(target)!r} ends with neither .csv nor .parquet; runs are written as one of them")
    if target.suffix.lower() == ".parquet" and importlib.util.find_spec("pyarrow") is None:
        raise DataError(f"{str(target)!r}: parquet needs pyarrow; run: pip install 'ftlm[parquet]'")
    check_free(target, force=force, words=RUN)
    left = partial_of(target)
    # A dangling link would have the rows written where it leads.
    if os.path.lexists(left) and not force:
        raise DataError(
            f"{str(left)!r} holds what was recorded by a program that did not end; load it, rename or remove it, or "
            "overwrite it with force=True (--force)"
        )


def check_times(duration: float, limit: float, rate: float) -> tuple[float, float, float]:
    """Times and a rate as floats; those that no run can have are refused."""
    longest, length, samples = finite(limit), finite(duration), finite(rate)
    if longest is None or not 0 < longest <= LONGEST:
        raise ModelError(f"limit = {shown(limit)} s is outside (0, {LONGEST:g}] s; give the longest time of a run")
    if length is None or length <= 0:
        raise ModelError(f"duration = {shown(duration)} s is not a time above 0; give the length of the run")
    if length > longest:
        way_out = "raise limit= (--limit)" if length <= LONGEST else f"no run is longer than {LONGEST:g} s"
        raise ModelError(f"duration = {length:g} s is over the limit of {longest:g} s; {way_out}")
    if samples is None or samples <= 0:
        raise ModelError(f"rate = {shown(rate)} Hz is not a positive number of samples per second")
    if length * samples < 2:
        raise ModelError(f"duration = {length:g} s holds fewer than three samples at {samples:g} Hz; make it longer")
    return length, longest, samples


def _column_of(name: str) -> int:
    """Where a row of a run holds a signal of the live structure."""
    if name not in COLUMNS:
        raise ModelError(f"the live structure needs {name!r}, which a rig does not record; it has {', '.join(COLUMNS)}")
    return COLUMNS.index(name)
