"""Checkpoint file of a structure selection: every fit and validation as it ends, for resumption."""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import Literal, TypeAlias, TypeVar

import msgspec
import numpy as np

from ftlm._core import __version__
from ftlm.data.run import Run
from ftlm.errors import ConvergenceError, DataError, FtlmError, ModelError
from ftlm.estimation.output_error import JointFit, UnstableOptimum
from ftlm.order_search import checkpoint as frames
from ftlm.order_search.checkpoint import SELECTION_FILE, FrameFile
from ftlm.structure.structure import History, Initial, Structure
from ftlm.structure_selection.best_subset import ScreenedSubset
from ftlm.structure_selection.candidates import Change, Variant
from ftlm.structure_selection.cross_validation import Trial
from ftlm.utils.validation import Floats

Made = TypeVar("Made")
#: Version of fit and validation. Results of different versions must not be combined.
ALGORITHM_VERSION = 3
#: Errors of a candidate's fit. Any other error is a defect.
ErrorName: TypeAlias = Literal["ConvergenceError", "DataError", "ModelError"]
CANDIDATE_ERRORS: dict[ErrorName, type[FtlmError]] = {
    "ConvergenceError": ConvergenceError,
    "DataError": DataError,
    "ModelError": ModelError,
}
#: Size of a double [bytes].
DOUBLE_BYTES = 8


def _encode_numpy(value: object) -> object:
    """Convert NumPy numbers to Python numbers, and a history to its powers."""
    if isinstance(value, (np.floating, np.integer, np.bool_)):
        return value.item()
    if isinstance(value, tuple):
        return tuple(value)
    # What msgspec asks of a hook that knows no better.
    raise NotImplementedError(type(value))


ANSWER_ENCODER = msgspec.msgpack.Encoder(enc_hook=_encode_numpy)


def _digest(value: object) -> bytes:
    return hashlib.blake2b(ANSWER_ENCODER.encode(value), digest_size=frames.DIGEST_BYTES).digest()


class Request(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="selection"):
    """First frame: digests of runs, candidates and validation."""

    algorithm: int
    version: str
    runs: bytes
    candidates: bytes
    validation: bytes

    @classmethod
    def of(cls, runs: Sequence[Run], candidates: object, judges: Sequence[Run], words: str) -> Request:
        """Build from runs, candidates, validation runs and the description of the validation."""
        return cls(
            ALGORITHM_VERSION,
            __version__,
            _digest([_run_content(r) for r in runs]),
            _digest(candidates),
            _digest([words, [_run_content(r) for r in judges]]),
        )

    def difference(self, other: Request) -> str | None:
        """Describe the difference to another request, or return None."""
        words = {"runs": "of other runs", "candidates": "of other candidates", "validation": "by another validation"}
        return next((said for n, said in words.items() if getattr(self, n) != getattr(other, n)), None)


def _run_content(run: Run) -> list[object]:
    """Return all data of a run that affect a fit."""
    own = run.sample_times
    times = [] if own is None else [own.times.tobytes(), {n: v.tobytes() for n, v in own.data.items()}]
    samples = {n: np.ascontiguousarray(run[n], "<f8").tobytes() for n in run.signals}
    return [run.name, run.step, run.inputs, run.outputs, samples, run.units, run.intersample, times]


class FitError(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="refused"):
    """Error of a candidate's fit."""

    kind: ErrorName
    words: str

    @classmethod
    def of(cls, error: FtlmError) -> FitError | None:
        """Serialize an error; None for an internal error, which is no result of a candidate."""
        return next((cls(n, str(error)) for n, kind in CANDIDATE_ERRORS.items() if type(error) is kind), None)

    def error(self) -> FtlmError:
        """Deserialize the error."""
        return CANDIDATE_ERRORS[self.kind](self.words)


class FitFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="fit"):
    """Fit on file; arrays are little-endian doubles."""

    orders: dict[str, float]
    coefficients: dict[str, float]
    inputs: dict[str, float]
    covariance: bytes
    on_grid: bytes
    noise: dict[str, float]
    cost: float
    samples: int
    refinement: int
    settled: bool
    converged: bool
    starts: tuple[tuple[float, str], ...]
    residuals: tuple[dict[str, bytes], ...]
    products: dict[str, tuple[float, tuple[str, ...]]]
    initial: Initial
    history: bool
    initial_terms: int
    origin: str
    growth: tuple[bool, float, bool] | None

    @classmethod
    def of(cls, joint: JointFit) -> FitFile:
        """Serialize a least-squares fit with Wald intervals."""
        growth = joint.unstable_optimum
        return cls(
            joint.orders,
            joint.coefficients,
            joint.inputs,
            _bytes(joint.covariance),
            _bytes(joint.finest_grid_values),
            joint.noise,
            joint.cost,
            joint.samples,
            joint.refinement,
            joint.step_converged,
            joint.converged,
            tuple(joint.starts),
            tuple({n: _bytes(e) for n, e in part.items()} for part in joint.residuals),
            dict(joint.products),
            joint.initial,
            isinstance(joint.initial, History),
            joint.initial_terms,
            joint.origin,
            None if growth is None else (growth.is_accepted, growth.residual_excess, growth.at_stability_limit),
        )

    @property
    def _count(self) -> int:
        return len(self.orders) + len(self.coefficients) + len(self.inputs)

    def inconsistency(self) -> str | None:
        """Describe inconsistent data, or return None."""
        if len(self.covariance) != DOUBLE_BYTES * self._count**2 or len(self.on_grid) != DOUBLE_BYTES * self._count:
            return f"a covariance or values of other than its {self._count} numbers"
        if any(len(e) % DOUBLE_BYTES for part in self.residuals for e in part.values()):
            return "residuals that are no doubles"
        if self.history and isinstance(self.initial, str):
            return f"a history that is no powers of t but {self.initial!r}"
        return None

    def joint(self) -> JointFit:
        """Deserialize the fit."""
        count = self._count
        told = History(self.initial) if self.history and not isinstance(self.initial, str) else self.initial
        return JointFit(
            dict(self.orders),
            dict(self.coefficients),
            _array(self.covariance).reshape(count, count),
            dict(self.noise),
            self.cost,
            self.samples,
            self.refinement,
            self.settled,
            self.converged,
            list(self.starts),
            [{n: _array(e) for n, e in part.items()} for part in self.residuals],
            dict(self.products),
            dict(self.inputs),
            told,
            self.initial_terms,
            finest_grid_values=_array(self.on_grid),
            origin=self.origin,
            unstable_optimum=None if self.growth is None else UnstableOptimum(*self.growth),
        )


class JudgementFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="judgement"):
    """Validation of a fitted candidate; the key includes its fit."""

    numbers: int
    estimation: dict[str, float]
    validation: dict[str, dict[str, float]]
    scores: tuple[float, ...]
    values: dict[str, float]
    errors: dict[str, float]
    idle: tuple[str, ...]
    grows: bool
    failed: str | None
    fine: bool

    @classmethod
    def of(cls, trial: Trial) -> JudgementFile:
        """Serialize a trial."""
        validation = {n: dict(part) for n, part in trial.validation.items()}
        return cls(
            trial.parameters,
            dict(trial.estimation),
            validation,
            trial.scores,
            dict(trial.values),
            dict(trial.errors),
            trial.insignificant,
            trial.unstable,
            trial.failed,
            trial.refined,
        )

    def trial(self, name: str, structure: Structure, joint: JointFit) -> Trial:
        """Deserialize the trial."""
        return Trial(
            name,
            structure,
            self.numbers,
            self.estimation,
            self.validation,
            self.scores,
            values=self.values,
            errors=self.errors,
            insignificant=self.idle,
            unstable=self.grows,
            failed=self.failed,
            refined=self.fine,
            joint=None if self.failed is not None else joint,
        )


class SubsetFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Subset of the best-subset search on file."""

    words: str
    coefficients: tuple[str, ...]
    integer_orders: tuple[tuple[str, float], ...]
    offset: bool
    inputs: tuple[str, ...]
    rubs: tuple[str, ...]
    start: dict[str, float]
    score: float

    @classmethod
    def of(cls, one: ScreenedSubset) -> SubsetFile:
        """Serialize a subset."""
        v = one.change.variant
        kept, inputs, rubs = (tuple(sorted(names)) for names in (v.coefficients, v.inputs, v.frictions))
        return cls(one.change.words, kept, v.integer_orders, v.offset, inputs, rubs, dict(one.start), one.score)

    def to_subset(self) -> ScreenedSubset:
        """Deserialize the subset."""
        variant = Variant(
            frozenset(self.coefficients), self.integer_orders, self.offset, frozenset(self.inputs), frozenset(self.rubs)
        )
        return ScreenedSubset(Change(self.words, variant), self.start, self.score)


class SubsetsFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="subsets"):
    """All subsets of the best-subset search on file."""

    each: tuple[SubsetFile, ...]

    @classmethod
    def of(cls, subsets: Sequence[ScreenedSubset]) -> SubsetsFile:
        """Serialize all subsets."""
        return cls(tuple(SubsetFile.of(s) for s in subsets))

    def subsets(self) -> list[ScreenedSubset]:
        """Deserialize all subsets."""
        return [s.to_subset() for s in self.each]


Answer = FitError | FitFile | JudgementFile | SubsetsFile


class StoredAnswer(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="kept"):
    """Result of a step, with the digest of its arguments."""

    request: bytes
    answer: Answer


ANSWER_DECODER = msgspec.msgpack.Decoder(Request | StoredAnswer)


def _bytes(values: Floats) -> bytes:
    return np.ascontiguousarray(values, "<f8").tobytes()


def _array(data: bytes) -> Floats:
    return np.frombuffer(data, "<f8").astype(np.float64)


class Store:
    """Results of a selection so far, locked until closed; safe for concurrent threads."""

    def __init__(self, path: str | os.PathLike[str], request: Request) -> None:
        self._known: dict[bytes, Answer] = {}
        self._lock = threading.Lock()
        self._log = FrameFile(path, SELECTION_FILE, create=True)
        try:
            data = self._log.read()
            if self._log.has_no_frame(data):
                data = self._log.begin(ANSWER_ENCODER.encode(request))
            self._take(data, request)
        except BaseException:
            self._log.close()
            raise

    def _take(self, data: bytes, request: Request) -> None:
        path, offset, digest = self._log.path, len(SELECTION_FILE.magic), bytes(frames.DIGEST_BYTES)
        view = memoryview(data)
        while offset < len(data):
            got = frames.next_frame(view, offset, digest)
            if got == "torn":
                break
            if isinstance(got, str):
                raise DataError(f"store {path} is damaged: {got}; choose another file, and leave this one")
            payload, digest, end = got
            try:
                frame = ANSWER_DECODER.decode(payload)
            except (msgspec.MsgspecError, ValueError, RecursionError, OverflowError) as error:
                raise DataError(
                    f"store {path} holds something else at byte {offset}: {error}; choose another file"
                ) from error
            if isinstance(frame, Request) != (offset == len(SELECTION_FILE.magic)):
                raise DataError(f"store {path} holds something else at byte {offset}; choose another file")
            # Digests tell what was damaged, not what was written wrong.
            wrong = (
                frame.answer.inconsistency()
                if isinstance(frame, StoredAnswer) and isinstance(frame.answer, FitFile)
                else None
            )
            if wrong is not None:
                raise DataError(f"store {path} holds a fit with {wrong} at byte {offset}; choose another file")
            if isinstance(frame, Request):
                self._check_same(request, frame)
            else:
                self._known[frame.request] = frame.answer
            offset = end
            self._log.end, self._log.digest = end, digest
        if self._log.end < len(data):
            # What a kill left of the last frame.
            self._log.truncate()

    def _check_same(self, asked: Request, held: Request) -> None:
        path = self._log.path
        # Digests are of what one version writes of candidates: those of another tell nothing.
        if (asked.algorithm, asked.version) != (held.algorithm, held.version):
            raise DataError(
                f"store {path} is of ftlm {held.version}, algorithm {held.algorithm}, and this is {asked.version}, "
                f"{asked.algorithm}: finish the selection with that version, or start it again in another file"
            )
        difference = asked.difference(held)
        if difference is not None:
            raise DataError(f"store {path} holds a selection {difference}; choose another file")

    def _other(self, asked: str, answer: Answer) -> DataError:
        held = {FitFile: "a fit", FitError: "an error", JudgementFile: "a judgement", SubsetsFile: "subsets"}
        return DataError(
            f"store {self._log.path} holds {held[type(answer)]} where {asked} was asked for; choose another file"
        )

    def __len__(self) -> int:
        return len(self._known)

    def recall_or_compute(
        self,
        asked: object,
        compute: Callable[[], Made],
        write: Callable[[Made], Answer | None],
        read: Callable[[Answer], Made],
    ) -> Made:
        """Return a stored result, or compute and store it; a None result is not stored."""
        key = _digest(asked)
        with self._lock:
            answer = self._known.get(key)
        if answer is None:
            made = compute()
            answer = write(made)
            if answer is None:
                return made
            with self._lock:
                self._log.append([ANSWER_ENCODER.encode(StoredAnswer(key, answer))])
                self._known[key] = answer
        # What is given is always what the store gives back, so that one that goes on has the same bits.
        return read(answer)

    def fit(
        self,
        structure: Structure,
        starts: Sequence[Mapping[str, float]],
        refine: bool,
        compute: Callable[[], JointFit | FtlmError],
    ) -> JointFit | FtlmError:
        """Return a fit on all runs, or its error."""

        def write(made: JointFit | FtlmError) -> Answer | None:
            if isinstance(made, JointFit):
                return FitFile.of(made)
            return FitError.of(made)

        def read(answer: Answer) -> JointFit | FtlmError:
            if isinstance(answer, FitFile):
                return answer.joint()
            if isinstance(answer, FitError):
                return answer.error()
            raise self._other("a fit", answer)

        return self.recall_or_compute(("fit", structure, [dict(s) for s in starts], refine), compute, write, read)

    def validation(
        self, name: str, structure: Structure, joint: JointFit, fine: bool, compute: Callable[[], Trial]
    ) -> Trial:
        """Return the trial of a fitted candidate on validation data."""

        def read(answer: Answer) -> Trial:
            if not isinstance(answer, JudgementFile):
                raise self._other("a judgement", answer)
            return answer.trial(name, structure, joint)

        asked = ("judge", structure, joint.names, _bytes(joint.values), joint.initial, fine)
        return self.recall_or_compute(asked, compute, JudgementFile.of, read)

    def subsets(self, structure: Structure, compute: Callable[[], list[ScreenedSubset]]) -> list[ScreenedSubset]:
        """Return all screened subsets."""

        def read(answer: Answer) -> list[ScreenedSubset]:
            if not isinstance(answer, SubsetsFile):
                raise self._other("subsets", answer)
            return answer.subsets()

        return self.recall_or_compute(("subsets", structure), compute, SubsetsFile.of, read)

    def close(self) -> None:
        """Close the file and release the lock."""
        self._log.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
