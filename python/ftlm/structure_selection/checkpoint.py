"""Checkpoint file of a structure selection, with every finished fit and validation.

An interrupted selection resumes from it.
"""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Literal, TypeAlias, TypeVar

import msgspec
import numpy as np

from ftlm._core import __version__
from ftlm.data.run import Run
from ftlm.errors import ConvergenceError, DataError, FtlmError, ModelError
from ftlm.estimation.output_error import JointFit
from ftlm.structure.structure import History, Structure
from ftlm.structure_selection.best_subset import ScreenedSubset
from ftlm.structure_selection.cross_validation import Trial
from ftlm.utils.checkpoint_file import DIGEST_BYTES, RECORD_ENCODER, CheckpointFile, decode_array

Result = TypeVar("Result")
Expected = TypeVar("Expected")
#: Version of the algorithms for fit and validation. Results of different versions must not be combined.
ALGORITHM_VERSION = 1
#: Errors of a candidate's fit. Any other error is a defect.
ErrorName: TypeAlias = Literal["ConvergenceError", "DataError", "ModelError"]
CANDIDATE_ERRORS: dict[ErrorName, type[FtlmError]] = {
    "ConvergenceError": ConvergenceError,
    "DataError": DataError,
    "ModelError": ModelError,
}


def _digest(value: object) -> bytes:
    return hashlib.blake2b(RECORD_ENCODER.encode(value), digest_size=DIGEST_BYTES).digest()


class Request(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="selection"):
    """First record of the file: digests that identify runs, candidates and validation."""

    algorithm: int
    version: str
    runs: bytes
    candidates: bytes
    validation: bytes

    @classmethod
    def of(cls, runs: Sequence[Run], candidates: object, validation_runs: Sequence[Run], words: str) -> Request:
        """Return the first record of the checkpoint file of a selection. `words` describe the validation."""
        return cls(
            ALGORITHM_VERSION,
            __version__,
            _digest([_run_content(r) for r in runs]),
            _digest(candidates),
            _digest([words, [_run_content(r) for r in validation_runs]]),
        )

    def difference(self, other: Request) -> str | None:
        """Return text on the first of runs, candidates and validation that differs from another request, else None."""
        descriptions = {
            "runs": "of other runs",
            "candidates": "of other candidates",
            "validation": "with other validation data",
        }
        return next((text for n, text in descriptions.items() if getattr(self, n) != getattr(other, n)), None)


def _run_content(run: Run) -> list[object]:
    """Return all data of a run that affect a fit, for a digest."""
    nonuniform_samples = run.nonuniform_samples
    times = (
        []
        if nonuniform_samples is None
        else [nonuniform_samples.times.tobytes(), {n: v.tobytes() for n, v in nonuniform_samples.data.items()}]
    )
    samples = {n: np.ascontiguousarray(run[n], "<f8").tobytes() for n in run.signals}
    return [run.name, run.step, run.inputs, run.outputs, samples, run.units, run.intersample, times]


class FitError(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="refused"):
    """Error of a candidate's fit, in the form in which it is stored."""

    kind: ErrorName
    words: str

    @classmethod
    def of(cls, error: FtlmError) -> FitError | None:
        """Return the stored form of an error; None for an internal error, which the candidate did not cause."""
        return next((cls(n, str(error)) for n, kind in CANDIDATE_ERRORS.items() if type(error) is kind), None)

    def error(self) -> FtlmError:
        """Return the error from its stored form."""
        return CANDIDATE_ERRORS[self.kind](self.words)


class StoredFit(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="fit"):
    """Joint fit in the form in which it is stored.

    Exponents of a history and exponents that the user gave are stored as equal lists. ``history`` distinguishes them.
    """

    joint: JointFit
    history: bool

    @classmethod
    def of(cls, joint: JointFit) -> StoredFit:
        """Return the stored form of a fit."""
        return cls(joint, isinstance(joint.initial, History))

    def inconsistency(self) -> str | None:
        """Return text that states how the stored data are inconsistent; None if they are consistent."""
        joint, count = self.joint, len(self.joint.names)
        if (joint.covariance.shape, joint.finest_grid_values.shape) != ((count, count), (count,)):
            return f"a covariance or values of another size than its {count} parameters"
        if any(e.ndim != 1 for run_residuals in joint.residuals for e in run_residuals.values()):
            return "residuals that are not one-dimensional"
        if self.history and isinstance(joint.initial, str):
            return f"the initial terms {joint.initial!r} instead of powers of t"
        return None

    def fit(self) -> JointFit:
        """Return the fit from its stored form."""
        initial = self.joint.initial
        if not self.history or isinstance(initial, str):
            return self.joint
        return replace(self.joint, initial=History(initial))


class StoredTrial(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="judgement"):
    """Trial in the form in which it is stored, without its fit, which the record's key identifies."""

    trial: Trial


class StoredSubsets(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="subsets"):
    """Result of a best-subset search in the form in which it is stored."""

    subsets: list[ScreenedSubset]


Answer = FitError | StoredFit | StoredTrial | StoredSubsets


class StoredAnswer(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="kept"):
    """Record with the result of one step of a selection, and the digest of the step's arguments."""

    request: bytes
    answer: Answer


ANSWER_DECODER = msgspec.msgpack.Decoder(Request | StoredAnswer, dec_hook=decode_array)


class Store:
    """Checkpoint file that is open for a selection, with the results so far.

    The file is locked until it is closed. Threads may use the store concurrently.
    """

    def __init__(self, path: str | os.PathLike[str], request: Request) -> None:
        self._results: dict[bytes, Answer] = {}
        self._lock = threading.Lock()
        self._file = CheckpointFile(path, "selection", "create")
        try:
            payloads, damage = self._file.read()
            if damage is not None:
                raise DataError(f"store {path} is damaged: {damage}; choose another file")
            if not payloads:
                payloads = [RECORD_ENCODER.encode(request)]
                self._file.append(payloads)
            for number, payload in enumerate(payloads, 1):
                self._load_record(number, payload, request)
        except BaseException:
            self._file.close()
            raise

    def _load_record(self, number: int, payload: bytes, request: Request) -> None:
        """Compare the first record with the request, or store the result in any other record for later use.

        `number` is the number of the record and `payload` its content.

        Raise DataError if the record is unexpected or inconsistent, or belongs to another selection.
        """
        path = self._file.path
        try:
            record = ANSWER_DECODER.decode(payload)
        except (msgspec.MsgspecError, ValueError, RecursionError, OverflowError) as error:
            raise DataError(
                f"store {path} has an unexpected entry in record {number}: {error}; choose another file"
            ) from error
        if isinstance(record, Request) != (number == 1):
            raise DataError(f"store {path} has an unexpected entry in record {number}; choose another file")
        if isinstance(record, Request):
            self._check_same(request, record)
            return
        # Digests detect damage, not wrong contents.
        inconsistency = record.answer.inconsistency() if isinstance(record.answer, StoredFit) else None
        if inconsistency is not None:
            raise DataError(f"store {path} contains a fit with {inconsistency} in record {number}; choose another file")
        self._results[record.request] = record.answer

    def _check_same(self, request: Request, stored: Request) -> None:
        path = self._file.path
        # Digests of candidates depend on the version that wrote them, so only those of one version can be compared.
        if (request.algorithm, request.version) != (stored.algorithm, stored.version):
            raise DataError(
                f"store {path} was written by ftlm {stored.version}, algorithm {stored.algorithm}; this is "
                f"{request.version}, algorithm {request.algorithm}: finish the selection with that version, or start "
                "it again in another file"
            )
        difference = request.difference(stored)
        if difference is not None:
            raise DataError(f"store {path} contains a selection {difference}; choose another file")

    def _check_result_type(self, result: Answer, kind: type[Expected], description: str) -> Expected:
        """Return a stored result if its type is `kind`, otherwise raise DataError.

        `description` is the name of the expected result in the message.
        """
        if isinstance(result, kind):
            return result
        descriptions = {StoredFit: "a fit", FitError: "an error", StoredTrial: "a validation", StoredSubsets: "subsets"}
        raise DataError(
            f"store {self._file.path} contains {descriptions[type(result)]} where {description} is expected; choose "
            "another file"
        )

    def __len__(self) -> int:
        return len(self._results)

    def recall_or_compute(
        self,
        request: object,
        compute: Callable[[], Result],
        encode: Callable[[Result], Answer | None],
        decode: Callable[[Answer], Result],
    ) -> Result:
        """Return the result of a step from the file, or compute it and store it there.

        `encode` returns the stored form of a result, and `decode` the result from its stored form. If `encode` returns
        None, the result is not stored.
        """
        key = _digest(request)
        with self._lock:
            stored = self._results.get(key)
        if stored is None:
            result = compute()
            stored = encode(result)
            if stored is None:
                return result
            with self._lock:
                self._file.append([RECORD_ENCODER.encode(StoredAnswer(key, stored))])
                self._results[key] = stored
        # Decode the stored form even of a new result, so that a resumed selection gives the same bits.
        return decode(stored)

    def fit(
        self,
        structure: Structure,
        starts: Sequence[Mapping[str, float]],
        refine: bool,
        compute: Callable[[], JointFit | FtlmError],
    ) -> JointFit | FtlmError:
        """Return the stored or computed fit of a structure on all runs, or the error of the fit."""

        def encode(result: JointFit | FtlmError) -> Answer | None:
            return StoredFit.of(result) if isinstance(result, JointFit) else FitError.of(result)

        def decode(result: Answer) -> JointFit | FtlmError:
            if isinstance(result, FitError):
                return result.error()
            return self._check_result_type(result, StoredFit, "a fit").fit()

        return self.recall_or_compute(("fit", structure, [dict(s) for s in starts], refine), compute, encode, decode)

    def validation(
        self, name: str, structure: Structure, joint: JointFit, is_final: bool, compute: Callable[[], Trial]
    ) -> Trial:
        """Return the stored or computed trial of a fitted candidate on validation data."""

        def decode(result: Answer) -> Trial:
            trial = self._check_result_type(result, StoredTrial, "a validation").trial
            fit = None if trial.failure is not None else joint
            return replace(trial, name=name, structure=structure, joint=fit)

        request = ("judge", structure, joint.names, joint.values, joint.initial, is_final)
        return self.recall_or_compute(request, compute, lambda trial: StoredTrial(replace(trial, joint=None)), decode)

    def subsets(self, structure: Structure, compute: Callable[[], list[ScreenedSubset]]) -> list[ScreenedSubset]:
        """Return the stored or computed result of the best-subset search."""

        def decode(result: Answer) -> list[ScreenedSubset]:
            return self._check_result_type(result, StoredSubsets, "subsets").subsets

        return self.recall_or_compute(("subsets", structure), compute, StoredSubsets, decode)

    def close(self) -> None:
        """Close the file and release the lock."""
        self._file.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
