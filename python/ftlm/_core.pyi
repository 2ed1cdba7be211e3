"""Compiled core in Rust: series algebra, estimators, order searches and simulation on arrays.

Arrays are float64, and are checked when they are passed to the core. A signal is a vector of block-pulse means unless
its name contains "samples". A record has one signal per row.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Literal, TypeAlias, TypedDict, final

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "SIMD",
    "Experiment",
    "Guard",
    "JointMultistart",
    "JointProblem",
    "OrderSearch",
    "OutputSimulation",
    "Points",
    "Recording",
    "StageSearch",
    "Stop",
    "Streaming",
    "VirtualArm",
    "__version__",
    "arx_model",
    "autocovariances",
    "block_pulse_kernels",
    "block_pulse_matrix",
    "certify",
    "chi_squared",
    "correlation",
    "cost_surface",
    "covariance_of",
    "delay_samples",
    "equation_error",
    "explicit_euler",
    "filter_series",
    "fit_covariance",
    "force_portable",
    "fractional_derivative",
    "fractional_integral",
    "fractional_memory",
    "friction_respond",
    "haar_inverse",
    "haar_matrix",
    "haar_transform",
    "has_unstable_pole",
    "instrumental_variables",
    "interpolate_samples",
    "is_white",
    "joint_fit",
    "joint_multistart",
    "kink_correction",
    "least_squares",
    "long_run_covariance",
    "metrics",
    "minimize",
    "multi_innovation",
    "multi_innovation_rows",
    "nonuniform_means",
    "nyquist_margin",
    "operational_matrix",
    "order_grid_size",
    "panic_on_purpose",
    "point_samples",
    "portmanteau",
    "prediction_ratio",
    "profile_intervals",
    "projected_errors",
    "pulse_mean_rows",
    "respond",
    "respond_with_initial",
    "richardson_limit",
    "search",
    "search_join",
    "search_plan",
    "search_stage",
    "series_divide",
    "series_multiply",
    "singular_values",
    "toeplitz_apply",
    "toeplitz_solve",
    "trace_errors",
    "triangular_factor",
    "variance_inflation",
    "whitening_filter",
]

_Vector: TypeAlias = np.ndarray[tuple[int], np.dtype[np.float64]]
_Matrix: TypeAlias = np.ndarray[tuple[int, int], np.dtype[np.float64]]
_Floats: TypeAlias = NDArray[np.float64]

#: Initial state of a record: (flags of signals with a sensor-filter transient, initial levels of the signals, responses
#: of the filter to an impulse and its derivatives as rows, or None).
_InitialState: TypeAlias = tuple[Sequence[bool], Sequence[float], _Floats | None]
#: (step [s], signals as rows, series of the sensor filter or None), followed by the initial state of a run with nonzero
#: initial conditions.
_Record: TypeAlias = tuple[float, _Floats, _Floats | None] | tuple[float, _Floats, _Floats | None, _InitialState]
#: (output, alpha, [(signal, order) of each term]). Signals are row indices of the record.
_Structure: TypeAlias = tuple[int, float, Sequence[tuple[int, float]]]
#: (structure, coefficient of each term)
_Equation: TypeAlias = tuple[_Structure, Sequence[float]]
#: Expression as a signal: (name, number) of each instruction, and (signal, order of the derivative) of each channel.
_Derived: TypeAlias = tuple[Sequence[tuple[str, float]], Sequence[tuple[int, float]]]
#: Initial terms: (True for Caputo's powers, exponents otherwise). Then optionally the offset (0 for none, 1 for a
#: constant, 2 for a constant and a ramp, 3 for an output level) and the number of impulses of a filter transient.
_Initial: TypeAlias = (
    tuple[bool, Sequence[float]] | tuple[bool, Sequence[float], int] | tuple[bool, Sequence[float], int, int]
)

class _Options(TypedDict):
    criterion: str
    norm: str
    #: Innovation length; 0 for least squares.
    innovation_length: int
    prior_covariance: float | None
    haar_rows: bool
    top: int
    threads: int
    pruning: bool
    #: Number of iterations of instrumental variables; 0 for another method.
    iterations: int
    #: Memory limit [bytes].
    memory: int

#: Order grid: (output, values of alpha, [(signal, values of the order, whether the terms of the signal are
#: interchangeable) of each term]).
_OrderGrid: TypeAlias = tuple[int, Sequence[float], Sequence[tuple[int, Sequence[float], bool]]]
#: Affine function of the free orders: (constant, weight of each free order).
_Affine: TypeAlias = tuple[float, Sequence[float]]
#: (output, alpha, [(signal, order) of each term]) with orders that follow from the order law.
_LawEquation: TypeAlias = tuple[int, _Affine, Sequence[tuple[int, _Affine]]]
#: Nonuniform samples: (sample times in pulses, (times in pulses, sizes) of the jumps of each signal with zero-order
#: hold, or None for other signals).
_NonuniformSamples: TypeAlias = tuple[_Floats, Sequence[tuple[_Floats, _Floats] | None]]

class _Experiment(TypedDict):
    record: _Record
    pulses_per_sample: int
    #: Measured samples, one row per output.
    samples: _Floats
    #: (series of the sensor filter, whether each output passes it); None without a filter.
    filter: tuple[_Floats, Sequence[bool]] | None
    #: One weight per output.
    weights: Sequence[float]
    #: (values at the samples or None, whether it has a zero-order hold) of each signal.
    signals: Sequence[tuple[_Floats | None, bool]]
    #: Robust weights of the samples, one row per output; None without a robust loss.
    robust_weights: _Floats | None
    sample_times: _NonuniformSamples | None

class _Channel(TypedDict):
    name: str
    samples: _Floats
    #: Samples at the nonuniform sample times of the run.
    nonuniform: _Floats | None
    #: "zoh" or "foh" for an input, "output", or "derived".
    role: str
    #: Known delay [s]; None without one.
    delay: float | None
    #: (law, value) of each saturation and dead zone, in the sequence in which they act. The value is None if it is
    #: free.
    limits: Sequence[tuple[str, float | None]]
    #: Whether the signal was measured through the sensor filter.
    filtered: bool
    #: Whether the signal enters the equation of another output.
    enters_others: bool

class _Run(TypedDict):
    name: str
    step: float
    #: Nonuniform sample times [s]; None for a regular grid.
    times: _Floats | None
    signals: Sequence[_Channel]
    #: Indices of the signals that are outputs of equations.
    outputs: Sequence[int]
    #: (coefficient, order) of the terms of numerator and denominator of the sensor filter; None without a filter.
    filter: tuple[Sequence[tuple[float, float]], Sequence[tuple[float, float]]] | None
    filter_states: int
    at_rest: bool
    coupled: bool
    friction: bool
    #: (signal, law) of each free delay, saturation or dead zone.
    free: Sequence[tuple[int, str]]

@final
class Recording:
    def __new__(cls, /, run: _Run) -> Recording: ...
    def pulses(
        self, /, m: int, filtered: bool
    ) -> tuple[float, _Matrix, _Vector | None, tuple[list[bool], list[float], _Matrix | None]]: ...
    def experiment(
        self,
        /,
        pulses_per_sample: int,
        decimation: int,
        weights: Sequence[float],
        robust_weights: _Floats | None = None,
    ) -> Experiment: ...
    def jumps(self, /, signal: int) -> tuple[_Vector, _Vector] | None: ...
    def values_at(self, /, signal: int, times: _Floats) -> _Vector | None: ...
    def acting_samples(self, /, signal: int) -> _Vector: ...

@final
class Experiment:
    @property
    def compared_count(self) -> int: ...
    @property
    def robust_weights(self) -> _Matrix | None: ...

_Progress: TypeAlias = Callable[[int, int, int], object]

#: (coefficients, initial terms of each record, exponents of the initial terms, (record, position) of each omitted one)
_Estimate: TypeAlias = tuple[list[float], list[list[float]], list[float], list[tuple[int, int]]]

_Counts = TypedDict(
    "_Counts",
    {"candidates": int, "kept": int, "beaten": int, "stopped early": int, "singular": int, "diverged": int},
)

_Part: TypeAlias = tuple[
    Sequence[tuple[int, float, Sequence[float], Sequence[Sequence[float]]]],
    Sequence[int],
    Sequence[tuple[int, bool]],
]
_Checkpoint: TypeAlias = tuple[tuple[int, int, int, int, float, int], bool, _Part]

#: (equation, first candidate, last candidate plus one, limit of the score)
_Span: TypeAlias = tuple[int, int, int, float]

class _FoundRow(TypedDict):
    index: int
    score: float
    alpha: float
    orders: list[float]
    coefficients: list[float]
    #: Initial terms of each record.
    initial: list[list[float]]

class _Found(TypedDict):
    rows: list[_FoundRow]
    counts: _Counts
    #: Number of candidates that were excluded as parts of boxes, among those excluded by a bound.
    boxed: int
    #: (index, alpha, orders, reason) of each failed candidate.
    failures: list[tuple[int, float, list[float], Literal["singular", "diverged"]]]

class _InstrumentalFit(TypedDict):
    estimates: list[_Estimate]
    covariances: list[list[float]]
    iterations: int
    converged: bool
    damped: bool

class _Certified(TypedDict):
    lower_bound: float
    best: float
    alpha: float
    orders: list[float]
    cells: int
    open: int

class _FoundStage(TypedDict):
    #: (index, score, free orders, equations) of each row. An equation is (score, alpha, orders, coefficients, initial
    #: terms of each record).
    rows: list[tuple[int, float, list[float], list[tuple[float, float, list[float], list[float], list[list[float]]]]]]
    counts: _Counts
    #: (index, free orders, reason) of the first hundred failed candidates.
    failures: list[tuple[int, list[float], Literal["singular", "diverged"]]]
    #: Number of distinct candidates of each equation.
    distinct: list[int]

__version__: Final[str]
SIMD: Final[str]

# ---------------------------------------------------------------------------------------------- kernels and transforms

def block_pulse_kernels(orders: _Floats, m: int, step: float, *, derivative: bool = False) -> _Matrix: ...
def toeplitz_apply(first_columns: _Floats, x: _Floats, groups: Sequence[int]) -> _Matrix: ...
def toeplitz_solve(first_columns: _Floats, b: _Floats, groups: Sequence[int]) -> _Matrix: ...
def haar_transform(x: _Floats) -> _Matrix: ...
def haar_inverse(x: _Floats) -> _Matrix: ...
def haar_matrix(m: int) -> _Matrix: ...
def block_pulse_matrix(order: float, m: int, step: float) -> _Matrix: ...
def operational_matrix(order: float, m: int, step: float, *, dense: bool = False) -> _Matrix: ...
def series_multiply(a: _Floats, b: _Floats, m: int, *, naive: bool = False) -> _Vector: ...
def series_divide(numerator: _Floats, divisor: _Floats, *, naive: bool = False) -> _Vector: ...
def fractional_integral(x: _Floats, order: float, step: float, rule: str) -> _Matrix: ...
def fractional_derivative(x: _Floats, order: float, step: float, definition: str, initial: _Floats) -> _Matrix: ...

# -------------------------------------------------------------------------------------------------- samples to records

def pulse_mean_rows(samples: _Floats, m: int, hold: bool) -> _Matrix: ...
def point_samples(means: _Floats) -> _Vector: ...
def nonuniform_means(times: _Floats, samples: _Floats, m: int, step: float, hold: bool) -> _Vector: ...
def delay_samples(samples: _Floats, delay: float, before: float) -> _Vector: ...
def filter_series(
    numerator: Sequence[tuple[float, float]], denominator: Sequence[tuple[float, float]], m: int, step: float
) -> _Vector: ...

# -------------------------------------------------------------------------------- tall matrices, their columns as rows

def triangular_factor(transpose: _Floats) -> _Matrix: ...
def singular_values(transpose: _Floats) -> tuple[_Matrix, _Vector, _Matrix]: ...

# ---------------------------------------------------------------------------------------------------------- estimators

def least_squares(
    runs: Sequence[_Record],
    equation: _Structure,
    inputs: Sequence[bool],
    fixed: Sequence[float | None],
    terms: _Initial,
) -> _Estimate: ...
def minimize(
    residuals: Callable[[_Floats], _Floats],
    jacobian: Callable[[_Floats], _Floats],
    start: _Floats,
    rows: _Floats,
    limits: _Floats,
    *,
    signal_norm: float = 0.0,
    evaluations: int = 120,
) -> tuple[_Floats, float, str, int, list[int]]: ...
def projected_errors(
    runs: Sequence[_Record],
    equation: _Structure,
    inputs: Sequence[bool],
    fixed: Sequence[float | None],
    terms: _Initial,
    autoregressive_orders: Sequence[float],
    points: Sequence[Sequence[float]],
) -> list[tuple[float, list[float]] | None]: ...
def multi_innovation(
    runs: Sequence[_Record],
    equation: _Structure,
    inputs: Sequence[bool],
    fixed: Sequence[float | None],
    terms: _Initial,
    length: int,
    prior_covariance: float | None,
    haar: bool,
    recursion: bool,
) -> tuple[_Estimate, _Matrix | None]: ...
def multi_innovation_rows(
    q: _Floats, m: _Floats, count: int, length: int, prior_covariance: Sequence[float], path: bool
) -> _Matrix: ...
def instrumental_variables(
    runs: Sequence[_Record],
    equations: Sequence[_Structure],
    inputs: Sequence[bool],
    fixed: Sequence[Sequence[float | None]],
    terms: _Initial,
    iterations: int,
    tolerance: float,
) -> _InstrumentalFit: ...
def has_unstable_pole(alpha: float, output_terms: Sequence[tuple[float, float]]) -> bool: ...

# ----------------------------------------------------------------------------------------------------------- joint fits

#: Affine function of the free orders: (constant, [(name, weight) of each free order]).
_Order: TypeAlias = tuple[float, Sequence[tuple[str, float]]]
#: (output, order, [(signal, order, coefficient, factor) of each term], [(factor, coefficient) of fc, fs and vs] or
#: None). A coefficient is a name if it is free, otherwise a number.
_NamedEquation: TypeAlias = tuple[
    int,
    _Order,
    Sequence[tuple[int, _Order, str | float, float]],
    Sequence[tuple[float, str | float]] | None,
]

class _Hints(TypedDict):
    highest: tuple[float, float] | None
    natural: Sequence[tuple[str, Sequence[float]]]
    exceeds: Sequence[tuple[str, float]]
    positive: Sequence[str]
    known: Sequence[tuple[str, float]]

class _Named(TypedDict):
    signals: Sequence[str]
    equations: Sequence[_NamedEquation]
    #: (name, (minimum, maximum)) of each order with bounds.
    bounds: Sequence[tuple[str, tuple[float, float]]]
    coupled: bool
    delayed: bool
    initial: _Initial
    history: bool
    #: (name, signal, law, bounds) of each free delay, saturation or dead zone.
    inputs: Sequence[tuple[str, int, str, tuple[float, float]]]
    #: (coefficient, sign, factors) of each coefficient law: the coefficient is the sign times the product of the
    #: factors.
    laws: Sequence[tuple[str, float, Sequence[str]]]
    hints: _Hints

class _Profile(TypedDict):
    intervals: list[tuple[int, float, float, list[tuple[float, float]], int]]
    lower_optimum: _Vector | None
    lower_on_finer_grid: bool
    incomplete: list[int]
    evaluations: int

class _JointFit(TypedDict):
    robust_weights: list[_Matrix] | None
    pulses_per_sample: int
    estimate: list[float]
    step_converged: bool
    covariance: _Matrix
    noise: list[float]
    #: Residuals of each run divided by the noise standard deviation, one row per output; NaN for a missing sample.
    residuals: list[_Matrix]
    #: (number of down-weighted residuals, number of outliers, number of residuals); None without a robust loss.
    robust: tuple[int, int, int] | None
    #: Fraction of the information on a parameter that its prior contributes, one per prior, in the order of parameters.
    prior_fractions: list[float]
    on_grid: _Vector
    #: Estimated initial states of each run, for models with friction.
    states: list[list[float]]
    cost: float
    status: str
    initial_terms: int
    #: (cost per residual, origin) of each initial guess.
    starts: list[tuple[float, str]]
    #: (cost per residual, parameters) of the distinct best candidates.
    survivors: list[tuple[float, list[float]]]
    #: Choice between an unstable and a stable optimum: (whether the unstable one is kept, relative excess of the
    #: residuals of the stable one, whether the stable one is at the stability limit); None if there was no such
    #: choice.
    unstable_optimum: tuple[bool, float, bool] | None

@final
class JointProblem:
    def __new__(cls, structure: _Named) -> JointProblem: ...
    @property
    def orders(self) -> list[str]: ...
    @property
    def coefficients(self) -> list[str]: ...
    @property
    def products(self) -> list[tuple[str, float, list[str]]]: ...
    @property
    def bounds(self) -> list[tuple[float, float]]: ...
    def feasible(self, /, start: _Floats, target: _Floats) -> _Vector: ...
    def minimize(
        self,
        /,
        runs: Sequence[Experiment | _Experiment],
        start: tuple[Sequence[float], Sequence[Sequence[float]]],
        plain: bool,
        fixed: Sequence[int],
        evaluations: int,
        tolerance: float,
        requires_stability: bool,
        stop: Stop | None = None,
    ) -> dict[str, Any]: ...

@final
class JointMultistart: ...

def joint_multistart(
    problem: JointProblem,
    runs: Sequence[Recording],
    resources: tuple[int, int],
    progress: Callable[[int, int], object] | None = None,
    stop: Stop | None = None,
) -> JointMultistart: ...
def joint_fit(
    problem: JointProblem,
    runs: Sequence[Recording],
    guesses: Sequence[Sequence[float]],
    initial_guess: Sequence[float] | None,
    warm_start: tuple[Sequence[float], Sequence[float], int] | None,
    candidates: JointMultistart | None,
    huber: bool,
    refine: bool,
    resources: tuple[int, int],
    progress: Callable[[int, int], object] | None = None,
    stop: Stop | None = None,
) -> _JointFit | None: ...
def profile_intervals(
    problem: JointProblem,
    runs: Sequence[Recording],
    fit: Mapping[str, Any],
    parameters: Sequence[int] | None,
    width: float,
    *,
    budget: tuple[int, int] | None = None,
    threads: int = 1,
    evaluations: int = 120,
    progress: Callable[[int, int], object] | None = None,
    stop: Stop | None = None,
) -> _Profile: ...
def cost_surface(
    problem: JointProblem,
    runs: Sequence[Recording],
    fit: Mapping[str, Any],
    pair: tuple[int, int],
    half_widths: tuple[float, float],
    points: int,
    *,
    refit: bool = True,
    evaluations: int = 20,
    stop: Stop | None = None,
) -> tuple[float, _Vector, _Vector, _Matrix]: ...
def covariance_of(jacobian: _Floats, series: Sequence[_Floats], squares: float) -> _Matrix: ...
def fit_covariance(
    jacobian: _Floats, series: Sequence[_Floats], robust_weights: _Floats | None, priors: int = 0
) -> _Matrix: ...
def long_run_covariance(jacobian: _Floats, series: Sequence[_Floats]) -> _Matrix: ...
def prediction_ratio(
    nested_columns: _Floats,
    full_columns: _Floats,
    residuals: _Floats,
    blocks: Sequence[Sequence[tuple[int, int]]],
    max_lag: int,
) -> float: ...
def whitening_filter(series: Sequence[_Floats], max_order: int) -> tuple[_Vector, float]: ...
def arx_model(
    series: Sequence[_Floats], inputs: Sequence[Sequence[_Floats]], max_order: int
) -> tuple[_Vector, int, list[_Vector], int]: ...
def autocovariances(series: Sequence[_Floats], max_lag: int) -> tuple[_Vector, _Vector]: ...
def portmanteau(series: Sequence[_Floats], lags: int) -> float: ...
def is_white(series: _Floats, lags: int) -> bool: ...
def variance_inflation(series: _Floats) -> float: ...
def chi_squared(degrees: float, quantile: float) -> float: ...

# ------------------------------------------------------------------------------------------------------------ friction

class _Motion(TypedDict):
    outputs: _Matrix
    velocity: _Matrix
    force: _Matrix
    stuck: Any

def friction_respond(
    run: _Record,
    equations: Sequence[_Equation],
    frictions: Sequence[tuple[int, tuple[float, float, float]]],
    terms: Sequence[Sequence[tuple[float, float]]],
) -> _Motion: ...

# ---------------------------------------------------------------------------------------------------------- simulation

def respond(
    run: _Record,
    model: Sequence[_Equation],
    inputs: Sequence[bool],
    terms: Sequence[Sequence[tuple[float, float]]],
) -> _Matrix: ...
def respond_with_initial(
    run: _Record,
    model: Sequence[_Equation],
    inputs: Sequence[bool],
    terms: _Initial,
    filter: tuple[_Floats, Sequence[bool]] | None,
) -> tuple[_Matrix, list[list[float]], list[list[float]]]: ...
def equation_error(run: _Record, equation: _Equation, inputs: Sequence[bool], terms: _Initial) -> _Vector: ...
def explicit_euler(signals: _Floats, step: float, model: Sequence[_Equation], inputs: Sequence[bool]) -> _Matrix: ...
def trace_errors(run: _Record, equation: _Structure, inputs: Sequence[bool], trace: _Floats) -> _Vector: ...
def nyquist_margin(output_terms: Sequence[tuple[float, float]], step: float) -> float: ...
def correlation(x: Sequence[_Floats], y: Sequence[_Floats], lags: int) -> tuple[_Vector, float, int]: ...
def richardson_limit(
    grids: Sequence[tuple[_Floats, Sequence[float]]], outputs: Sequence[int]
) -> tuple[_Matrix, _Vector, list[float]]: ...

#: Initial terms: (whether their coefficients are fitted, [(exponent, coefficient) of each term] of each equation,
#: whether output levels are also fitted).
_Terms: TypeAlias = tuple[bool, Sequence[Sequence[tuple[float, float]]], bool]

@final
class OutputSimulation:
    def __new__(
        cls,
        /,
        run: Recording,
        model: Sequence[_Equation],
        frictions: Sequence[tuple[int, tuple[float, float, float]]],
        times: _Floats | None,
        derived: Sequence[_Derived] = ...,
    ) -> OutputSimulation: ...
    def samples(
        self, /, pulses_per_sample: int, terms: _Terms, stop: Stop | None = None
    ) -> tuple[_Matrix, list[list[tuple[float, float]]]]: ...
    def exact_samples(
        self, /, terms: _Terms, stop: Stop | None = None
    ) -> tuple[_Matrix, list[list[tuple[float, float]]]] | None: ...
    def refine(
        self,
        /,
        terms: _Terms,
        tolerance: float,
        max_pulses: int,
        long_record_intervals: int,
        memory: int,
        stop: Stop | None = None,
    ) -> tuple[tuple[_Matrix, list[list[tuple[float, float]]]], int, _Vector]: ...
    def fit_past_inputs(
        self,
        /,
        exponents: Sequence[Sequence[float]],
        free: Sequence[Sequence[float]],
        has_level: bool,
        tolerance: float,
        max_pulses: int,
        long_record_intervals: int,
        memory: int,
        stop: Stop | None = None,
    ) -> list[list[tuple[float, float]]] | None: ...
    def fit_initial_states(
        self, /, initial_terms: _Initial, pulses_per_sample: int, stop: Stop | None = None
    ) -> list[list[tuple[float, float]]]: ...

def interpolate_samples(means: _Floats, positions: _Floats) -> _Matrix: ...
def kink_correction(
    m: int, positions: _Floats, jumps: tuple[_Floats, _Floats], order: float, step: float
) -> _Vector: ...
def metrics(measured: _Floats, residuals: _Floats) -> tuple[float, float, float, float]: ...

# ------------------------------------------------------------------------------------------------------------ searches

def certify(
    runs: Sequence[_Record],
    *,
    output: int,
    alpha: tuple[float, float],
    terms: Sequence[tuple[int, float, float]],
    min_separation: float,
    tolerance: float,
    max_term_ratio: float,
    max_cells: int,
    threads: int,
    memory: int,
    progress: _Progress | None,
) -> _Certified: ...
def order_grid_size(orders: _OrderGrid, inputs: Sequence[bool]) -> int: ...
def search(
    runs: Sequence[_Record],
    orders: _OrderGrid,
    inputs: Sequence[bool],
    fixed: Sequence[float | None],
    terms: _Initial,
    settings: _Options,
    progress: _Progress | None,
) -> _Found: ...
def panic_on_purpose(place: str) -> None: ...
def force_portable(is_forced: bool) -> None: ...
def search_plan(
    orders: _OrderGrid, inputs: Sequence[bool], terms: _Initial, settings: _Options
) -> tuple[int, list[int]]: ...
def search_join(
    orders: _OrderGrid,
    inputs: Sequence[bool],
    terms: _Initial,
    settings: _Options,
    samples: int,
    parts: Sequence[_Part],
) -> _Found: ...

@final
class OrderSearch:
    def __new__(
        cls,
        runs: Sequence[_Record],
        orders: _OrderGrid,
        inputs: Sequence[bool],
        fixed: Sequence[float | None],
        terms: _Initial,
        settings: _Options,
    ) -> OrderSearch: ...
    def evaluate_batches(
        self,
        first: int,
        last: int,
        seed: Sequence[tuple[int, float]],
        start: _Checkpoint | None,
        threads: int,
        progress: _Progress | None,
        save: Callable[[_Checkpoint | None], object] | None,
    ) -> _Part: ...

def search_stage(
    runs: Sequence[_Record],
    axes: Sequence[Sequence[float]],
    laws: Sequence[_LawEquation],
    inputs: Sequence[bool],
    fixed: Sequence[Sequence[float | None]],
    scales: Sequence[float],
    terms: _Initial,
    settings: _Options,
    progress: _Progress | None,
) -> _FoundStage: ...

@final
class StageSearch:
    def __new__(
        cls,
        runs: Sequence[_Record],
        axes: Sequence[Sequence[float]],
        laws: Sequence[_LawEquation],
        inputs: Sequence[bool],
        fixed: Sequence[Sequence[float | None]],
        scales: Sequence[float],
        terms: _Initial,
        settings: _Options,
        keeps_state: bool,
    ) -> StageSearch: ...
    def pending_spans(self) -> list[_Span]: ...
    def state(self) -> tuple[int, float | None]: ...
    def evaluate_spans(
        self, spans: Sequence[_Span], threads: int, progress: _Progress | None
    ) -> tuple[bytes, bytes]: ...
    def record_outcomes(self, values: bytes, kinds: bytes, threads: int) -> None: ...
    def outcome(self) -> _FoundStage: ...

@final
class Points:
    def __new__(
        cls, runs: Sequence[_Record], output: int, signals: Sequence[int], inputs: Sequence[bool], squares: bool
    ) -> Points: ...
    def scores(self, candidates: _Matrix, limit: float, threads: int) -> _Vector: ...

@final
class Guard:
    def __new__(cls, settings: Mapping[str, Any]) -> Guard: ...
    def rest(self, analog: Sequence[float], counts: Sequence[int], switches: Sequence[int]) -> None: ...
    def read(
        self, analog: Sequence[float], counts: Sequence[int], switches: Sequence[int], delay: float
    ) -> list[float]: ...
    def command(self, current: Sequence[float]) -> list[float]: ...
    def fail(self, reason: str) -> None: ...
    @property
    def fault(self) -> str | None: ...
    @property
    def last_currents(self) -> list[float]: ...
    @property
    def bias(self) -> list[float]: ...
    @property
    def missed_deadlines(self) -> int: ...

@final
class Stop:
    def __new__(cls) -> Stop: ...
    def set(self) -> None: ...
    @property
    def is_set(self) -> bool: ...

@final
class Streaming:
    def __new__(
        cls,
        step: float,
        max_pulses: int,
        inputs: Sequence[bool],
        equations: Sequence[tuple[_Structure, Sequence[float | None]]],
        length: int,
        prior_covariance: float | None,
        forgetting: float,
        terms: _Initial,
    ) -> Streaming: ...
    def push(self, samples: _Floats) -> _Matrix: ...
    @property
    def coefficients(self) -> list[list[float]]: ...
    @property
    def pulses(self) -> int: ...

@final
class VirtualArm:
    def __new__(
        cls, arm: Mapping[str, Any], sensors: Mapping[str, Any], step: float, longest_substep: float, horizon: float
    ) -> VirtualArm: ...
    def start(self, paced: bool) -> None: ...
    def read(self, noise: Sequence[float]) -> tuple[list[float], list[int], list[int]]: ...
    def advance(self, volts: Sequence[float], enabled: bool) -> None: ...
    def inject(self, fault: str, channel: int, sample: int, value: float) -> None: ...
    def rest(
        self, guard: Guard, noise: _Matrix, output: Callable[[float, float], tuple[tuple[float, float], bool]]
    ) -> None: ...
    def run(
        self,
        guard: Guard,
        commands: _Matrix,
        noise: _Matrix,
        output: Callable[[float, float], tuple[tuple[float, float], bool]],
    ) -> None: ...
    def take(self) -> _Matrix: ...
    @property
    def sample(self) -> int: ...
    @property
    def angles(self) -> list[float]: ...
    @property
    def memory(self) -> int: ...

def fractional_memory(samples: _Vector, order: float, step: float, tolerance: float) -> tuple[_Vector, int]: ...
