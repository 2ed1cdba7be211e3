"""Recording of experiments on a rig: command sources, recording loop, and files that are written during a run."""

from __future__ import annotations

import contextlib
import importlib.util
import math
import os
import signal
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from ftlm.data.construction import RunArguments
from ftlm.data.export import Header
from ftlm.data.run import Run
from ftlm.errors import DataError, FtlmError, ModelError, RigFault
from ftlm.estimation.linear import Streaming
from ftlm.rig.arm_parameters import ArmParameters
from ftlm.rig.excitation import CURRENT_SIGNALS, Excitation, finite_number
from ftlm.rig.quanser import QuanserBoard
from ftlm.rig.rig import MAX_RUN_DURATION_S, RIG_COLUMNS, Board, Limits, Rig, check_rate, check_thread, describe_signal
from ftlm.rig.virtual_board import VirtualBoard
from ftlm.utils.arguments import check_arguments
from ftlm.utils.files import check_writable
from ftlm.utils.parameters import parameter, setting, type_name
from ftlm.utils.validation import CSV_TIME, Floats, check_choice, check_seed, is_run_name, short_repr

COLUMN_UNITS = {name: "A" if name.startswith("I") else "rad" for name in RIG_COLUMNS}


def units_of(extra_columns: tuple[str, ...] = ()) -> dict[str, str]:
    """Return the unit of each column of a recorded run by name; `extra_columns` are angles [rad]."""
    return COLUMN_UNITS | dict.fromkeys(extra_columns, "rad")


def partial_path(target: Path) -> Path:
    """Return the path of the temporary csv file that is written during a run, next to the final file `target`."""
    return target.with_name(target.stem + ".csv.partial")


class PartialRecording:
    """Csv file that is written during an experiment, so that data are not lost if the program terminates unexpectedly.

    Parameters
    ----------
    target
        Path of the final file, from which the path of this file is derived. With None nothing is written to disk.
    name, step, details
        Name, sampling interval [s] and metadata of the run.
    extra_columns
        Names of additional inputs, which follow the columns of the rig.
    """

    def __init__(
        self, target: Path | None, name: str, step: float, details: dict[str, Any], extra_columns: tuple[str, ...] = ()
    ) -> None:
        self.path = None if target is None else partial_path(target)
        self._step, self._rows = step, 0
        self._columns = (*RIG_COLUMNS, *extra_columns)
        #: Number of complete rows in the file.
        self.kept = 0
        self._descriptor: int | None = None
        self._opened = False
        inputs = (*CURRENT_SIGNALS, *extra_columns)
        self._header = Header(
            name,
            step,
            0.0,
            inputs,
            tuple(RIG_COLUMNS[2:]),
            units_of(extra_columns),
            dict.fromkeys(inputs, "zoh"),
            ("the recording did not end: the program died, or the disk was full",),
            details | {"faults": ["the recording did not end"]},
        )

    def open(self) -> None:
        """Create the file and write its header.

        Raises
        ------
        DataError
            If the file cannot be written. The file is then removed.
        """
        if self.path is None:
            return
        lines = f"{self._header.line()}{','.join([CSV_TIME, *self._columns])}\n"
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
        try:
            # If the path is a symbolic link, the link is replaced and its target is kept.
            self.path.unlink(missing_ok=True)
            self._opened = True
            self._descriptor = os.open(self.path, flags, 0o666)
            self._append(lines.encode())
        except OSError as error:
            self.remove()
            reason = error.strerror or error
            raise DataError(
                f"{str(self.path)!r} cannot be written ({reason}); check the folder and the space left"
            ) from None

    def write(self, rows: Floats) -> None:
        """Append samples to the file, shape (n, number of columns).

        Raises
        ------
        RigFault
            If the samples cannot be written. Rows written earlier remain in the file.
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
            raise RigFault(
                f"the recording cannot be written to disk ({error.strerror or error}); free disk space"
            ) from None

    def _append(self, content: bytes) -> None:
        if self._descriptor is None:
            return
        file_length = os.lseek(self._descriptor, 0, os.SEEK_END)
        try:
            while content:
                content = content[os.write(self._descriptor, content) :]
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, file_length)
            raise

    def close(self) -> None:
        """Close the file. A file without rows is deleted, because it would prevent the next recording."""
        if self.kept == 0:
            self.remove()
        self._close_descriptor()

    def remove(self) -> None:
        """Close and delete the file, which is no longer needed once the run is in its final file."""
        self._close_descriptor()
        if self.path is not None and self._opened:
            with contextlib.suppress(OSError):
                self.path.unlink()

    def _close_descriptor(self) -> None:
        if self._descriptor is not None:
            with contextlib.suppress(OSError):
                os.close(self._descriptor)
            self._descriptor = None


def save_run(
    run: Run | None,
    target: Path | None,
    partial: PartialRecording,
    *,
    force: bool,
    ended: BaseException | None,
    faults: list[str],
) -> Run:
    """Write a recorded run to its final file, and return the run, or raise the exception that ended it early.

    Parameters
    ----------
    run
        Recorded run; None if too few samples were recorded.
    target
        Path of the final file; None for no file.
    partial
        File that was written during the run. It is removed once the final file is complete.
    force
        Whether to overwrite the final file.
    ended
        Exception that ended the run early, or None.
    faults
        Fault messages of the run.

    Raises
    ------
    RigFault
        If there is a fault, no run, or the final file cannot be written. Its `run` is the recorded run.
    BaseException
        The exception `ended`, if it is not a RigFault, with a note on where the samples are.
    """
    saved_text = "nothing was recorded until then"
    if run is not None:
        saved_text = f"{run.length} rows were recorded until then"
        if target is not None:
            try:
                save = run.to_csv if target.suffix.lower() == ".csv" else run.to_parquet
                save(target, force=force)
                partial.remove()
                saved_text += f" and are in {target}"
            except DataError as error:
                partial.close()
                saved_text += (
                    f"; {partial.kept} of them are in {partial.path}" if partial.kept else "; none could be written"
                )
                fault = RigFault(f"{error}; {saved_text}")
                if ended is not None:
                    fault = RigFault(f"{'; '.join(faults)}; {saved_text}")
                fault.run = run
                raise fault from None
    else:
        partial.remove()
    if ended is not None and not isinstance(ended, RigFault):
        ended.add_note(saved_text)
        raise ended
    if ended is not None or faults or run is None:
        fault = RigFault(f"{'; '.join(faults) or 'no sample was read'}; {saved_text}")
        fault.run = run
        # Keep the exception of a controller as the cause.
        raise fault from (None if ended is None else ended.__cause__)
    return run


#: Low-pass filter of the deflections in the arm's stock real-time model: natural frequency [rad/s] and damping ratio.
STOCK_FILTER = (math.sqrt(157.9137), 22.6195 / (2.0 * math.sqrt(157.9137)))
#: Number of samples that are written to disk together. In real time it is small, so that writing takes less than one
#: sampling interval.
_BLOCK_ROWS_REAL_TIME, _BLOCK_ROWS_FAST = 32, 500


@check_arguments
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
    real_time: bool = False,
    sensor_filter: Literal["stock"] | None = None,
    watchdog: float = 0.1,
    arm: bool = False,
    board: str = "0",
    name: str | None = None,
    out: str | os.PathLike[str] | None = None,
    force: bool = False,
    live: Streaming | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Run:
    """Apply a current signal to both motors of a rig, and record currents and angles.

    Every command is limited in amplitude, slew rate and thermal load, and every sample is checked. Also after a fault
    or an interruption, 0 V is written, the amplifiers are disabled, and the recorded samples are kept.

    Parameters
    ----------
    rig : {"virtual", "q8"} or Board, default "virtual"
        The simulated arm, the arm on a Q8-USB board, or a user-defined board.
    input : str
        Shape of the current: square, sine, chirp, multisine, prbs, doublet or csv; see :class:`Excitation`.
    amplitude : float or pair of float
        Maximum current [A] of both motors, or (motor 1, motor 2); at most 0.94 for motor 1 and 1.2 for motor 2.
    period : float, optional
        Period [s]; for prbs the switching interval. The default depends on the shape; see :class:`Excitation`.
    band : pair of float
        Frequency band of chirp and multisine [Hz].
    ramp : float
        Duration of the linear ramp of the amplitude from zero [s].
    file : path, optional
        File with the currents for ``input="csv"``, in the columns I1 and I2 [A].
    duration : float
        Duration [s], above 0 and at most `limit`.
    limit : float
        Maximum permitted duration [s], at most 600.
    rate : float
        Sampling rate [Hz], 1 to 8000.
    seed : int
        Seed of the simulated noise and of random inputs. Equal seeds give equal runs.
    parameters : str, path or ArmParameters
        Parameters of the simulated arm: ``"effective"``, ``"measured"``, ``"measured-lqr"``, ``"linear"`` (no friction,
        coupling or noise), or a TOML file.
    offset : pair of float, optional
        Current offset of each motor of the simulated arm while the amplifiers are enabled [A]. The default is that of
        `parameters`, which is 0 in the named sets. On hardware the offset differs from run to run.
    real_time : bool
        Whether the virtual rig runs in real time.
    sensor_filter : {"stock"}, optional
        ``"stock"`` applies the 2 Hz low-pass of the arm's stock real-time model to the recorded deflections.
    watchdog : float
        Time without a write after which the watchdog stops the motors [s], 0.01 to 1.
    arm : bool
        Confirmation that the real arm may move. It must be True for hardware.
    board : str
        Identifier of the Q8-USB, such as ``"0"`` or ``"0@tcpip://host:port"``.
    name : str, optional
        Name of the run; by default the shape of the input.
    out : path, optional
        File to write, with the suffix .csv or .parquet.
    force : bool
        Whether to overwrite an existing file.
    live : Streaming, optional
        Recursive identification that is updated with every recorded sample. Its last estimate is stored in the
        `metadata` of the run.
    progress : callable, optional
        Callback with (recorded samples, total samples), called after the update of `live`.

    Returns
    -------
    Run
        Run with the inputs I1, I2 [A] as commanded (zero-order hold), and the outputs theta11, theta12, theta21,
        theta22 [rad] and I1_measured, I2_measured [A]. Its `metadata` has rig, seed, input, parameters, missed
        deadlines and faults.

    Raises
    ------
    ModelError
        If an argument is out of range, or hardware is used without ``arm=True``. The arm has not moved.
    DataError
        If a file cannot be read or already exists. The arm has not moved.
    RigFault
        If the rig stopped the run. The message states the cause. The recorded samples are in the attribute `run` of the
        exception and in the file.
    BaseException
        On Ctrl-C, SIGTERM, or an exception of `progress`, after shutdown and after the file is written. Notes of the
        exception list errors of the shutdown, and where the samples are. In a thread other than the main one, Ctrl-C
        raises RigFault.
    """
    seed = check_seed(seed)
    duration, limit, rate = check_times(duration, limit, rate)
    excitation = Excitation(input, amplitude, period, band, ramp, seed, file)
    commands = excitation.commands(rate, duration)
    name = excitation.shape if name is None else name
    board_options = rig, seed, parameters, offset, real_time, sensor_filter, watchdog, arm, board
    experiment = Experiment(*board_options, duration, limit, rate, name, out, force, live, progress)
    return experiment.record_run(lambda board: FixedCommands(commands), {"input": excitation.to_dict()})


class CommandSource(Protocol):
    """Protocol of an object that supplies the commands of the motor currents in a run.

    `rows` is the number of commands.
    """

    rows: int
    #: Additional input signals of the run by name, one value per sample.
    extra_signals: dict[str, Floats]

    def first_commands(self, rig: Rig, block: int) -> Floats:
        """Return the first commands [A] of the motor currents, shape (n, 2) with n at most `block`."""

    def next_commands(self, rows: Floats) -> Floats:
        """Return the commands [A] that follow the last measured samples `rows`; empty at the end of the run."""

    def explain_fault(self, fault: str) -> str:
        """Return a fault message, with an added explanation if this source contributed to the fault."""


@dataclass(frozen=True)
class Experiment:
    """Arguments of an experiment, after validation of seed and times; see :func:`record`."""

    rig: str | Board
    seed: int
    parameters: str | os.PathLike[str] | ArmParameters
    offset: tuple[float, float] | None
    real_time: bool
    sensor_filter: Literal["stock"] | None
    watchdog: float
    arm: bool
    board: str
    duration: float
    limit: float
    rate: float
    name: str
    out: str | os.PathLike[str] | None
    force: bool
    live: Streaming | None
    progress: Callable[[int, int], None] | None

    def select_board(self) -> tuple[Board, dict[str, Any]]:
        """Return the selected board and metadata on the board.

        Raise ModelError or DataError if rig, offset or parameters are invalid.
        """
        virtual = isinstance(self.rig, str) and self.rig == "virtual"
        if self.offset is not None and not virtual:
            raise ModelError("offset applies only to the virtual arm; leave it out for a board")
        if virtual:
            arm = ArmParameters.load(self.parameters)
            if self.offset is not None:
                try:
                    first, second = (float(v) for v in self.offset)
                except (TypeError, ValueError, OverflowError):
                    first = second = math.nan
                if isinstance(self.offset, str) or not (math.isfinite(first) and math.isfinite(second)):
                    raise ModelError(
                        f"{setting('offset')} {short_repr(self.offset)} is not a pair of currents; give those "
                        "of motor 1 and motor 2 [A]"
                    )
                arm = replace(arm, current_offset=(first, second))
            board = VirtualBoard(arm, seed=self.seed, real_time=self.real_time, horizon=self.limit)
            return board, {"parameters": arm.to_dict()}
        if isinstance(self.rig, str):
            check_choice("rig", self.rig, ("virtual", "q8"))
            return QuanserBoard(card=self.board), {"card": self.board}
        if not hasattr(self.rig, "hardware"):
            raise ModelError(f"rig is {type_name(self.rig)}; use 'virtual', 'q8' or a board of your own")
        rig_parameters = getattr(self.rig, "parameters", None)
        return self.rig, {"parameters": rig_parameters.to_dict()} if isinstance(rig_parameters, ArmParameters) else {}

    def record_run(self, make_source: Callable[[Board], CommandSource], more_details: dict[str, Any]) -> Run:
        """Run the experiment and return the recorded run.

        `make_source` returns the command source for the selected board, and `more_details` are added to the metadata.
        Raise ModelError or DataError for invalid arguments, and RigFault if the rig stops the run.
        """
        # Flags that permit an arm to move must be bool; other values that count as true are rejected.
        for name, flag in (("real_time", self.real_time), ("arm", self.arm), ("force", self.force)):
            if not isinstance(flag, bool):
                raise ModelError(f"{setting(name)} {short_repr(flag)} is neither True nor False; use one of them")
        if self.progress is not None and not callable(self.progress):
            raise ModelError(f"progress is {type_name(self.progress)}; give a function of (done, total)")
        if self.sensor_filter is not None and not (
            isinstance(self.sensor_filter, str) and self.sensor_filter == "stock"
        ):
            raise ModelError(
                f"{setting('sensor_filter')} {short_repr(self.sensor_filter)} is not known; use 'stock' or None"
            )
        board, details = self.select_board()
        paced = self.real_time or board.hardware or bool(getattr(board, "real_time", False))
        if board.hardware and not self.arm:
            raise ModelError(
                f"the {board.name} moves a real arm: clear its workspace, keep the emergency stop at hand, and "
                f"confirm with {parameter('arm', True)}"
            )
        check_thread(board)
        if not is_run_name(self.name):
            raise DataError(f"{setting('name')} {short_repr(self.name)} cannot name a run; give one line of text")
        target = None if self.out is None else Path(self.out)
        if target is not None:
            _check_target(target, force=self.force)
        source = make_source(board)
        run_details: dict[str, Any] = {
            "rig": board.name,
            "seed": self.seed,
            "rate": self.rate,
            "duration": self.duration,
            "real_time": paced,
            "watchdog": self.watchdog,
            "sensor_filter": self.sensor_filter,
            **more_details,
            **details,
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
        if live is not None and not math.isclose(live.step, step, rel_tol=1e-9):
            raise ModelError(
                f"{setting('live')} a stream with a step of {live.step:g} s, and the rig has {step:g} s; make it for "
                "the rig's rate"
            )
        columns = [] if live is None else [_column_of(signal_name) for signal_name in live.signals]
        partial = PartialRecording(target, self.name, step, run_details, tuple(source.extra_signals))
        recorder = _Recorder(
            partial, source, self.progress, live, columns, _BLOCK_ROWS_REAL_TIME if paced else _BLOCK_ROWS_FAST
        )
        # Until the file is written, a second signal must not end the program.
        link.signals.uninterruptible |= {_Recorder.collect.__code__}
        try:
            link.signals.keep()
            partial.open()
            ended, faults = _run_commands(link, recorder)
            run_details |= {"missed_deadlines": link.guard.missed_deadlines, "faults": faults}
            if live is not None:
                run_details["live"] = {
                    "coefficients": live.coefficients,
                    "pulses": live.pulses,
                    "trouble": recorder.live_error,
                }
            run = recorder.finish(self.name, run_details, faults, step)
            saved = save_run(run, target, partial, force=self.force, ended=ended, faults=faults)
        finally:
            partial.close()
            link.signals.release()
        link.signals.deliver()
        return saved


class FixedCommands:
    """Command source with precomputed commands of the motor currents [A], shape (rows, 2)."""

    def __init__(self, commands: Floats) -> None:
        self.commands, self.rows = commands, len(commands)
        self.extra_signals: dict[str, Floats] = {}
        self._at = self._block = 0

    def first_commands(self, rig: Rig, block: int) -> Floats:
        """Return the first commands [A], shape (n, 2) with n at most `block`; later blocks have the same size."""
        self._at, self._block = block, block
        return self.commands[:block]

    def next_commands(self, rows: Floats) -> Floats:
        """Return the next block of commands [A]; the measured samples are ignored."""
        start, self._at = self._at, self._at + self._block
        return self.commands[start : start + self._block]

    def explain_fault(self, fault: str) -> str:
        """Return the fault message unchanged."""
        return fault


def _run_commands(link: Rig, recorder: _Recorder) -> tuple[BaseException | None, list[str]]:
    """Run all commands of the recorder's source on a rig.

    Return the exception that ended the run early, or None, and all fault messages.
    """
    faults: list[str] = []
    ended: BaseException | None = None
    try:
        with link:
            recorder.follow(link)
    except RigFault as error:
        ended = error
        faults.append(recorder.source.explain_fault(str(error)))
    except (KeyboardInterrupt, SystemExit) as error:
        ended = error
        faults.append(recorder.source.explain_fault(describe_interruption(error)))
    except BaseException as error:
        # An error of the program, such as in `progress`, is raised again after the recorded samples are written.
        ended = error
        faults.append(f"stopped by an error of the program ({type(error).__name__}: {error})")
    if ended is not None and not isinstance(ended, RigFault):
        for shutdown_error in link.shutdown_errors:
            ended.add_note(shutdown_error)
    return ended, faults + [t for t in link.shutdown_errors if t not in faults]


def describe_interruption(ended: KeyboardInterrupt | SystemExit) -> str:
    """Return the text "stopped by …" for a run that Ctrl-C, another signal or an exit of the program has ended."""
    if isinstance(ended, KeyboardInterrupt):
        return describe_signal(signal.SIGINT)
    return describe_signal(ended.code - 128 if isinstance(ended.code, int) else 0)


@dataclass
class _Recorder:
    """Recorder that runs the commands of a source on a rig, and stores the samples in memory and in a file.

    `columns` are the indices of the rig's columns for the signals of `live`. `block` is the number of samples that are
    written to the file together. `sample_blocks` are arrays of all recorded samples. `live_error` is the message of the
    error that ended the recursive identification `live`, or None.
    """

    partial: PartialRecording
    source: CommandSource
    progress: Callable[[int, int], None] | None
    live: Streaming | None
    columns: list[int]
    block: int
    live_error: str | None = None
    sample_blocks: list[Floats] = field(default_factory=list)
    #: Number of arrays in `sample_blocks` that were written to the file, and total number of their rows.
    written_blocks: int = 0
    row_count: int = 0

    def follow(self, rig: Rig) -> None:
        """Run all commands of the source on a rig, and store the measured samples."""
        try:
            commands = self.source.first_commands(rig, self.block)
            while len(commands):
                try:
                    rig.run(commands)
                finally:
                    rows = self.collect(rig)
                rig.signals.deliver()
                if sum(map(len, self.sample_blocks[self.written_blocks :])) >= self.block:
                    self.flush()
                commands = self.source.next_commands(rows)
        finally:
            self.flush()

    def collect(self, rig: Rig) -> Floats:
        """Fetch the samples that the rig recorded since the last call, store and return them.

        Signals are deferred during the call, so that no sample is lost.
        """
        self.sample_blocks.append(rig.take())
        return self.sample_blocks[-1]

    def flush(self) -> None:
        """Pass stored samples that are not in the file yet to the file, to `live`, and to the progress callback."""
        pending, self.written_blocks = self.sample_blocks[self.written_blocks :], len(self.sample_blocks)
        rows = self._columns(pending, self.row_count)
        if not len(rows):
            return
        self.row_count += len(rows)
        self.partial.write(rows)
        if self.live is not None and self.live_error is None:
            try:
                self.live.push(rows[:, self.columns])
            except FtlmError as error:
                # A failed live estimate must not stop the run, which can be identified afterwards.
                self.live_error = str(error)
        if self.progress is not None:
            self.progress(self.row_count, self.source.rows)

    def _columns(self, blocks: list[Floats], start: int) -> Floats:
        """Return samples of consecutive blocks without the delay column, with the extra signals of the source appended.

        `start` is the index of the first sample in the run.
        """
        rows = np.concatenate([np.empty((0, len(RIG_COLUMNS) + 1)), *blocks])[:, : len(RIG_COLUMNS)]
        extra_values = [values[start : start + len(rows), None] for values in self.source.extra_signals.values()]
        return np.hstack([rows, *extra_values])

    def finish(self, name: str, details: dict[str, Any], faults: list[str], step: float) -> Run | None:
        """Return the recorded run with `details` and `faults`; None if it has fewer than three samples."""
        extra_names = tuple(self.source.extra_signals)
        rows = self._columns(self.sample_blocks, 0)
        if len(rows) < 3:
            return None
        data = {column: rows[:, k] for k, column in enumerate((*RIG_COLUMNS, *extra_names))}
        facts = tuple(f"the rig stopped the run after {(len(rows) - 1) * step:.6g} s: {f}" for f in faults)
        signals = {n: data[n] for n in (*CURRENT_SIGNALS, *extra_names)}, {n: data[n] for n in RIG_COLUMNS[2:]}
        arguments = RunArguments(
            *signals, step=step, units=units_of(extra_names), name=name, notes=facts, metadata=details
        )
        return Run._from_checked(**arguments.checked_fields())


def _check_target(target: Path, *, force: bool) -> None:
    if target.suffix.lower() not in (".csv", ".parquet"):
        raise DataError(f"{str(target)!r} ends with neither .csv nor .parquet; runs are written as one of them")
    if target.suffix.lower() == ".parquet" and importlib.util.find_spec("pyarrow") is None:
        raise DataError(f"{str(target)!r}: parquet needs pyarrow; run: pip install 'ftlm[parquet]'")
    check_writable(target, force=force)
    partial = partial_path(target)
    # The path is also occupied if it is a symbolic link to a missing file.
    if os.path.lexists(partial) and not force:
        raise DataError(
            f"{str(partial)!r} contains the recording of a program that was interrupted; load it, rename or remove "
            f"it, or overwrite it with {parameter('force', True)}"
        )


def check_times(duration: float, limit: float, rate: float) -> tuple[float, float, float]:
    """Return (duration [s], limit [s], rate [Hz]) as floats.

    Raise ModelError if one is out of range, the duration exceeds the limit, or the run has fewer than three samples.
    """
    longest, length, samples = finite_number(limit), finite_number(duration), finite_number(rate)
    if longest is None or not 0 < longest <= MAX_RUN_DURATION_S:
        raise ModelError(
            f"{setting('limit')} {short_repr(limit)} s is outside (0, {MAX_RUN_DURATION_S:g}] s; give the longest "
            "time of a run"
        )
    if length is None or length <= 0:
        raise ModelError(
            f"{setting('duration')} {short_repr(duration)} s is not a time above 0; give the length of the run"
        )
    if length > longest:
        way_out = (
            f"raise {parameter('limit')}"
            if length <= MAX_RUN_DURATION_S
            else f"no run is longer than {MAX_RUN_DURATION_S:g} s"
        )
        raise ModelError(f"{setting('duration')} {length:g} s exceeds the limit of {longest:g} s; {way_out}")
    if samples is None or samples <= 0:
        raise ModelError(f"{setting('rate')} {short_repr(rate)} Hz is not positive; give samples per second")
    check_rate(samples)
    if length * samples < 2:
        raise ModelError(
            f"{setting('duration')} {length:g} s has fewer than three samples at {samples:g} Hz; make it longer"
        )
    return length, longest, samples


def _column_of(name: str) -> int:
    """Return the index of a signal among the columns of the rig; raise ModelError if the rig does not record it."""
    if name not in RIG_COLUMNS:
        raise ModelError(
            f"the live structure needs {name!r}, which a rig does not record; it has {', '.join(RIG_COLUMNS)}"
        )
    return RIG_COLUMNS.index(name)
