"""Result of a frequency-domain fit, its validation, and charts of measured and modeled responses."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from ftlm.analysis.frequency_response import covariance_of, frequency_response, response_deviation, response_inputs
from ftlm.analysis.model_algebra import Ratio
from ftlm.data.frequency_data import FrequencyData, as_frequency_data
from ftlm.errors import DataError, FtlmError, ModelError
from ftlm.estimation.model_checks import has_unstable_mode, unstable_poles_text
from ftlm.estimation.response_problem import is_impedance
from ftlm.estimation.verdict import TRUST_LEVEL, Verdict, verdict_from, verdict_html
from ftlm.findings import Finding, group_findings, make_finding, texts
from ftlm.model.model import Model
from ftlm.model.parameter_estimates import Parameter, parameter_estimates, parameter_frame
from ftlm.structure.circuit import Circuit
from ftlm.structure.order import MAX_IMPROPER_ORDER
from ftlm.svg.charts import PlaneChart
from ftlm.svg.figure import SMALL_WIDTH_PX, Figure
from ftlm.svg.html_page import Page, Section, Table
from ftlm.svg.line_chart import LineChart
from ftlm.utils.arguments import check_arguments
from ftlm.utils.files import to_frame
from ftlm.utils.formatting import Cell, attributes, format_bound, number, symbol, wrap_text
from ftlm.utils.parameters import choose_text, parameter, use_interface
from ftlm.utils.statistics import NORMAL_95
from ftlm.utils.validation import Complex, Floats
from ftlm.validation.information_criteria import InformationCriteria, information_table

DECIBELS_PER_NEPER = 20.0 / np.log(10.0)
#: Number of points of a smooth curve over the measured band.
CURVE_POINTS = 160


def curve_frequencies(record: FrequencyData) -> Floats:
    """Return frequencies [rad/s] for a smooth curve, including all frequencies of the record.

    Between any two neighboring measured frequencies there is at least one other frequency, at which the chart has no
    measured value. Measured points are therefore drawn as separate dots.
    """
    frequencies = np.unique(record.frequency)
    midpoints = np.sqrt(frequencies[1:] * frequencies[:-1])
    curve = np.geomspace(frequencies[0], frequencies[-1], CURVE_POINTS) if frequencies.size > 1 else frequencies
    return np.unique(np.concatenate([frequencies, midpoints, curve]))


def _response_indices(model: Model, record: FrequencyData) -> tuple[int, int]:
    """Return the indices of a record's output and input in the frequency response of the model."""
    return model.outputs.index(record.output), response_inputs(model, coupled=True).index(record.input)


def model_response(model: Model | Circuit, record: FrequencyData, omega: Floats) -> Complex:
    """Return the complex response of a model at `omega` [rad/s], from the input to the output of a record."""
    if isinstance(model, Circuit):
        return model.impedance(omega)
    response: Complex = frequency_response(model, omega)[_response_indices(model, record)]
    return response


def model_curve(
    model: Model | Circuit, record: FrequencyData, omega: Floats
) -> tuple[Complex, Floats | None, Floats | None]:
    """Return a model's complex response and the half-widths of its 95 % bands of gain [dB] and phase [degrees].

    The half-widths are None for a circuit, and if the model has no covariance.
    """
    response = model_response(model, record, omega)
    if isinstance(model, Circuit) or covariance_of(model) is None:
        return response, None, None
    gain, phase = (deviation[_response_indices(model, record)] for deviation in response_deviation(model, omega))
    return response, DECIBELS_PER_NEPER * NORMAL_95 * gain, np.degrees(NORMAL_95 * phase)


def frequency_chart(
    title: str, label: str, omega: Floats, lines: Sequence[tuple[str, Floats]], half_width: Floats | None
) -> LineChart:
    """Return a chart of named lines over frequency, the first one with a band of the given half-width."""
    values = lines[0][1]
    return LineChart(
        omega,
        lines,
        title=title,
        x_label="frequency [rad/s]",
        y_label=label,
        caption="" if half_width is None else "Shade: 95 % band, from the covariance of the fit.",
        bands=[] if half_width is None else [(values - half_width, values + half_width)],
        log_x=True,
        dots=("measured",),
        width=SMALL_WIDTH_PX,
        height=220,
    )


def record_charts(model: Model | Circuit, record: FrequencyData) -> tuple[LineChart, LineChart]:
    """Return the gain chart and the phase chart: measured response, model, and 95 % confidence band of the model.

    For an impedance, the first chart shows the magnitude over the frequency in Hz.
    """
    omega = curve_frequencies(record)
    response, uncertain_response, wrapped = model_curve(model, record, omega)
    phase = np.degrees(np.unwrap(np.angle(response)))
    order = np.argsort(record.frequency, kind="stable")
    at = np.searchsorted(omega, record.frequency[order])
    # Phases that differ by whole turns are equal.
    angles = record.phase[order] - 360.0 * np.round(np.median(record.phase[order] - phase[at]) / 360.0)
    title = f"{symbol(record.output)} from {symbol(record.input)}, {record.name}"

    def chart(kind: str, label: str, values: Floats, half_width: Floats | None, measurements: Floats) -> LineChart:
        dots = np.full(omega.size, np.nan)
        dots[at] = measurements
        lines = [("model", values), ("measured", dots)]
        return frequency_chart(f"{title}: {kind}", label, omega, lines, half_width)

    size = f"gain [dB of {record.unit}]" if record.unit else "gain [dB]"
    gains = chart("gain", size, DECIBELS_PER_NEPER * np.log(np.abs(response)), uncertain_response, record.gain[order])
    phases = chart("phase", "phase [degrees]", phase, wrapped, angles)
    if not is_impedance(record):
        return gains, phases
    hertz: dict[str, Any] = {"x": omega / (2.0 * math.pi), "x_label": "frequency [Hz]"}
    return (
        replace(
            gains,
            **hertz,
            title=f"{title}: |Z|",
            y_label=f"|Z| [{record.unit}]",
            lines=[(name, np.exp(values / DECIBELS_PER_NEPER)) for name, values in gains.lines],
            bands=[(np.exp(low / DECIBELS_PER_NEPER), np.exp(high / DECIBELS_PER_NEPER)) for low, high in gains.bands],
            log_y=True,
        ),
        replace(phases, **hertz),
    )


def nyquist_chart(model: Model | Circuit, record: FrequencyData) -> PlaneChart:
    """Return the Nyquist chart of a record and the model; the vertical axis of an impedance is -Im Z."""
    response, measured = model_response(model, record, curve_frequencies(record)), record.response
    unit = f" [{record.unit}]" if record.unit else ""
    impedance = is_impedance(record)
    return PlaneChart(
        measured.conj() if impedance else measured,
        curve=response.conj() if impedance else response,
        title=f"{symbol(record.output)} from {symbol(record.input)}, {record.name}: Nyquist",
        x_label=f"Re Z{unit}" if impedance else f"real part{unit}",
        y_label=f"−Im Z{unit}" if impedance else f"imaginary part{unit}",
    )


def response_figures(model: Model | Circuit, record: FrequencyData) -> list[Figure]:
    """Return the Nyquist and Bode charts of a record and the model; for an impedance the Nyquist chart comes first."""
    bode, nyquist = record_charts(model, record), nyquist_chart(model, record)
    return [nyquist, *bode] if is_impedance(record) else [*bode, nyquist]


def relative_residual_figure(model: Model | Circuit, record: FrequencyData) -> LineChart:
    """Return the chart of model minus measured response over frequency, in percent of the measured magnitude."""
    order = np.argsort(record.frequency, kind="stable")
    omega = record.frequency[order]
    response = model_response(model, record, omega)
    magnitude = np.abs(record.response[order])
    relative_errors = (
        100.0 * (response - record.response[order]) / np.where(magnitude > 0, magnitude, np.max(magnitude) or 1.0)
    )
    hertz = is_impedance(record)
    return LineChart(
        omega / (2.0 * math.pi) if hertz else omega,
        [("real part", relative_errors.real), ("imaginary part", relative_errors.imag)],
        log_x=True,
        width=SMALL_WIDTH_PX,
        height=220,
        title=f"{symbol(record.output)} from {symbol(record.input)}, {record.name}: residuals",
        x_label="frequency [Hz]" if hertz else "frequency [rad/s]",
        y_label="model − measured [% of size]",
    )


#: Maximum RMS error of a usable model, relative to the measured response.
MAX_RELATIVE_ERROR = 0.5
#: A model fails on a validation record if its relative RMS error there exceeds both limits. The first is a multiple of
#: the largest estimation error, the second is absolute.
VALIDATION_ERROR_RATIO, MIN_VALIDATION_ERROR = 3.0, 0.02


@dataclass(frozen=True)
class ResponseError:
    """Relative error of a model on one measured frequency response.

    Parameters
    ----------
    name
        Name of the record.
    output, input
        Output and input of the response.
    rms, largest
        Root mean square and maximum of the complex error, relative to the measured response [%].
    at
        Frequency of the largest error [rad/s].
    """

    name: str
    output: str
    input: str
    rms: float
    largest: float
    at: float


@dataclass(frozen=True)
class FrequencyValidation:
    """Validation of a model on frequency responses that it was not fitted to.

    Parameters
    ----------
    data
        Validation responses.
    errors
        Error of the model on each response.
    verdict
        Verdict on the model that takes this validation into account.
    findings
        Findings about the errors on the validation responses.
    """

    data: tuple[FrequencyData, ...]
    errors: tuple[ResponseError, ...]
    verdict: Verdict
    findings: tuple[Finding, ...] = field(default=())

    @property
    def warnings(self) -> tuple[str, ...]:
        """Findings as sentences."""
        return texts(self.findings)

    @property
    def fit(self) -> dict[str, float]:
        """Fit in percent by output: 100 minus the root mean square error in percent of the measured response."""
        return _fit_of(self.errors)

    #: Same as `fit`, under a name that states the unit.
    fit_percent = fit

    def to_frame(self) -> Any:
        """Return a pandas DataFrame with one row per validation response: signals and relative errors in percent."""
        return to_frame([vars(e) for e in self.errors], ["name"])

    def to_dict(self) -> dict[str, Any]:
        """Return the result as a dictionary for JSON."""
        return {
            "errors": [vars(e) for e in self.errors],
            **attributes(self, ("findings", "warnings")),
            "verdict": self.verdict.to_dict(),
        }

    def __str__(self) -> str:
        return "\n".join([*wrap_text(str(self.verdict)), *_errors_in_words(self.errors)])


@dataclass(frozen=True, eq=False)
class FrequencyIdentification:
    """Result of :func:`ftlm.identify_frequency`.

    Parameters
    ----------
    system
        Identified model or circuit.
    data
        Records to which it was fitted.
    weights
        Weighting of the residuals: ``"deviation"``, ``"relative"`` or ``"uniform"``.
    values, standard_errors, intervals
        Estimates of orders, coefficients and delays [s], their standard errors, and their 95 % intervals (low, high),
        by name. The standard error of a parameter that is not identifiable is infinite. A circuit parameter on a bound
        of the user has neither error nor interval; one that is not distinguishable from 0 has the lower bound 0.
    names, covariance
        Names of the parameters with a standard error, and their covariance matrix in the same sequence.
    chi_squared
        Mean square of the residuals divided by the stated standard deviations; about 1 for a correct model. None if no
        standard deviations are stated.
    converged
        Whether the fit converged.
    start_counts
        Number of initial guesses from which this optimum was reached, and total number of initial guesses.
    white
        Whether the residuals pass a whiteness test over frequency at 99 %.
    findings
        Findings about the model.
    information
        AIC, AICc and BIC. They compare circuits or equations fitted to the same records with the same weights. Real and
        imaginary parts count as separate samples. None if unknown.
    """

    system: Model | Circuit
    data: tuple[FrequencyData, ...]
    weights: str
    values: Mapping[str, float]
    standard_errors: Mapping[str, float]
    intervals: Mapping[str, tuple[float, float]]
    names: tuple[str, ...]
    covariance: Floats
    chi_squared: float | None
    converged: bool
    start_counts: tuple[int, int]
    white: bool
    findings: tuple[Finding, ...] = field(default=())
    information: InformationCriteria | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Findings as sentences."""
        return texts(self.findings)

    @property
    def circuit(self) -> Circuit:
        """Circuit that was identified, with the estimated element values.

        Raises
        ------
        ModelError
            If equations were identified.
        """
        if isinstance(self.system, Model):
            raise ModelError("equations were identified, not a circuit; use .model")
        return self.system

    @cached_property
    def model(self) -> Model:
        """Model that was identified; for a circuit the fractional equation with the same impedance.

        Raises
        ------
        ModelError
            If the circuit's impedance is not a ratio of sums of powers of s.
        """
        if isinstance(self.system, Model):
            return self.system
        numerator, denominator = self.system.polynomials()
        output, input = self.data[0].output, self.data[0].input
        # An inductor in series is a derivative of the current.
        model = Ratio(numerator, denominator, 0.0).model(output, input, improper_order=MAX_IMPROPER_ORDER)
        return replace(model, units={output: "V", input: "A"})

    @property
    def orders(self) -> dict[str, float]:
        """Estimates of the free orders by name; empty for a circuit."""
        return {n: v for n, v in self.values.items() if isinstance(self.system, Model) and n in self.system.orders}

    @property
    def coefficients(self) -> dict[str, float]:
        """Estimates of all free parameters by name, except orders and delays."""
        return {n: v for n, v in self.values.items() if n not in self.orders and not n.startswith("delay_")}

    @property
    def errors(self) -> tuple[ResponseError, ...]:
        """Error of the model on each record."""
        return tuple(error_of(self.system, record) for record in self.data)

    @check_arguments
    def validate(self, data: FrequencyData | Sequence[FrequencyData]) -> FrequencyValidation:
        """Compare the model with responses that it was not fitted to.

        Parameters
        ----------
        data
            Records of outputs and inputs of the model.

        Returns
        -------
        FrequencyValidation
            Error on each record, and the verdict that takes these errors into account.

        Raises
        ------
        DataError
            If a record has signals that the model lacks.
        """
        records = tuple(assign_signals(self.system, record) for record in as_frequency_data(data))
        errors = tuple(error_of(self.system, record) for record in records)
        return FrequencyValidation(records, errors, self._assess(errors, records), self._validation_findings(errors))

    def _validation_findings(self, validation_errors: Sequence[ResponseError]) -> tuple[Finding, ...]:
        """Return a finding on each response with a large error, and one on an error far above the estimation errors."""
        findings = _large_error_findings(validation_errors)
        largest_error = max(e.rms for e in self.errors)
        failures = [
            e
            for e in validation_errors
            if e.rms > VALIDATION_ERROR_RATIO * largest_error and e.rms > 100 * MIN_VALIDATION_ERROR
        ]
        if failures:
            findings.append(make_finding("response_lost", run=failures[0].name, own=largest_error, rms=failures[0].rms))
        return tuple(findings)

    @property
    def parameters(self) -> dict[str, Parameter]:
        """Orders, coefficients and delays by name, each with its standard error, 95 % interval and unit."""
        coefficients = self.system.values if isinstance(self.system, Circuit) else self.system.coefficients
        values = {**self.values, **coefficients}
        return parameter_estimates(
            self.system, values, errors=self.standard_errors, intervals=self.intervals, free=self.names
        )

    @property
    def fit(self) -> dict[str, float]:
        """Fit in percent by output: 100 minus the root mean square error in percent of the measured response."""
        return _fit_of(self.errors)

    #: Same as `fit`, under a name that states the unit.
    fit_percent = fit

    def to_frame(self) -> Any:
        """Return a pandas DataFrame of the parameters: value, standard error, 95 % interval, unit, nominal value."""
        return parameter_frame(
            self.parameters.values(), self.system.structure.nominal_values if isinstance(self.system, Model) else {}
        )

    @property
    def verdict(self) -> Verdict:
        """Verdict on the model without validation data; :meth:`validate` gives one that includes such data.

        It is "do not use" if a parameter is not identifiable, the error exceeds half of a response, or the model is
        unstable. It is "with care" if residuals are not white or exceed the stated standard deviations, a parameter is
        uncertain, the fit did not converge or ended on a bound, or there is no validation. A validation error above 2 %
        and three times the estimation error also gives "with care".
        """
        return self._assess(None)

    def _assess(
        self, validation_errors: tuple[ResponseError, ...] | None, data: Sequence[FrequencyData] = ()
    ) -> Verdict:
        findings = [
            *_large_error_findings(self.errors),
            *_large_error_findings(validation_errors or ()),
            *self._unstable_poles(),
        ]
        findings += [group.first_finding for group in group_findings(self.findings)]
        findings += [f for f in self._validation_findings(validation_errors or ()) if f not in findings]
        is_same_data = any(np.array_equal(a.response, b.response) for a in data for b in self.data)
        if validation_errors is None or is_same_data:
            findings.append(make_finding("response_not_validated"))
        limiting = verdict_from(findings)
        if limiting is not None:
            return limiting
        errors_text = ", ".join(f"{e.name} {e.rms:.2g} %" for e in validation_errors or ())
        return Verdict(TRUST_LEVEL, f"it predicts validation responses (error {errors_text}), residuals are noise")

    def _unstable_poles(self) -> list[Finding]:
        """Return a finding on poles with a positive real part, if there are any."""
        if isinstance(self.system, Circuit):
            # Elements above 0 dissipate.
            return []
        with contextlib.suppress(FtlmError):
            stable = self.model.stability(coupling="simulated")
            if stable.unstable_poles > 0 and has_unstable_mode(self.model, "simulated"):
                return [make_finding("response_grows", poles=unstable_poles_text(stable.unstable_poles))]
        return []

    @check_arguments
    def summary(self, validation: FrequencyValidation | None = None) -> str:
        """Return the summary as text: verdict, equations, parameters, modes, errors and warnings."""
        from ftlm.report.text_summary import behavior_lines, equation_lines, finding_lines

        verdict = self.verdict if validation is None else validation.verdict
        lines = [*wrap_text(str(verdict)), ""]
        lines += [str(self.system)] if isinstance(self.system, Circuit) else equation_lines(self.system)
        lines.append("")
        lines += self._parameter_lines()
        lines += [*([] if isinstance(self.system, Circuit) else behavior_lines(self.system)), ""]
        lines += _errors_in_words(self.errors)
        if validation is not None:
            lines += ["validation", *_errors_in_words(validation.errors)[1:]]
        if self.chi_squared is not None:
            lines.append(f"residuals over stated deviations: {math.sqrt(self.chi_squared):.3g} (1 of a right model)")
        same_count, total = self.start_counts
        lines.append(
            f"residuals white: {'yes' if self.white else 'no'}; weights: {self.weights}; {same_count} of {total} "
            "initial guesses ended here"
        )
        if self.information is not None:
            lines.append(str(self.information))
        return "\n".join(
            [
                *lines,
                *(f"note: {w}" for r in self.data for w in r.warnings),
                *finding_lines(self.findings, choose_text("result.warnings", "--report FILE shows all")),
            ]
        )

    def _parameter_lines(self) -> list[str]:
        rows = []
        for p in self.parameters.values():
            low, high = p.interval
            interval = f"[{format_bound(low, '.5g')}, {format_bound(high, '.5g')}]"
            error = "fixed" if p.fixed else f"± {format_bound(p.standard_error)}"
            rows.append((p.name, f"{p.value:.6g}", error, "" if p.fixed else interval, p.unit))
        widths = [max(len(row[k]) for row in rows) for k in range(4)]
        lines = [
            f"  {a:<{widths[0]}}  {b:>{widths[1]}} {c:<{widths[2]}}  {d:<{widths[3]}}  {e}".rstrip()
            for a, b, c, d, e in rows
        ]
        return [*lines, "  (± is one standard error, in brackets the 95 % interval)"]

    def figures(self) -> list[Figure]:
        """Return Bode and Nyquist charts of model and measured points for each record, and residual charts."""
        model = self.system
        return [f for r in self.data for f in (*response_figures(model, r), relative_residual_figure(model, r))]

    @check_arguments
    def report(
        self, path: str | os.PathLike[str], *, validation: FrequencyValidation | None = None, force: bool = False
    ) -> Path:
        """Write an HTML page with verdict, equations, parameters, Bode and Nyquist charts, which opens offline.

        Parameters
        ----------
        path
            File to write.
        validation
            Result of :meth:`validate`.
        force
            Overwrite an existing file.

        Returns
        -------
        Path
            Path of the written file.

        Raises
        ------
        DataError
            If the file exists and ``force`` is False, or it cannot be written.
        """
        with use_interface("report"):
            page = self._page(validation)
        return page.write(path, force=force)

    def _page(self, validation: FrequencyValidation | None) -> Page:
        """Return the content of the report."""
        from ftlm.report.html_report import behavior_figures, behavior_tables, first_findings, model_title, verdict_box

        main_findings, further_findings = first_findings(self.findings)
        source = self.system
        validation_data = () if validation is None else validation.data
        charts = Section(
            f"{'Validation' if validation_data else 'Estimation'}: measured and modeled response",
            figures=[f for record in validation_data or self.data for f in response_figures(self.system, record)],
            small=True,
        )
        data_section = Section(
            "Model",
            [self._equations_html()],
            warnings=main_findings,
            more=further_findings,
            tables=[self._parameter_table(), *([] if isinstance(source, Circuit) else behavior_tables(source))],
            figures=[] if isinstance(source, Circuit) else behavior_figures(source),
            small=True,
        )
        rows: list[list[Cell]] = [_error_row("estimation", e) for e in self.errors]
        rows += [] if validation is None else [_error_row("validation", e) for e in validation.errors]
        headings = ("data", "record", "response", "error, % rms", "largest, %", "at [Hz]")
        notes = [w for r in self.data for w in r.warnings]
        figures = [relative_residual_figure(self.system, record) for record in self.data]
        residuals = Section(
            "Residuals" if not validation_data else "Residuals, and the fit to the estimation data",
            [f"Weights: {self.weights}. Residuals white: {'yes' if self.white else 'no'} (99 %).", *notes],
            tables=[
                Table("Error over the size of the measured response", headings, rows),
                *([] if self.information is None else [information_table(self.information)]),
            ],
            figures=self.figures() if validation_data else figures,
            small=True,
            collapsed=bool(validation_data),
        )
        return Page(
            f"Impedance of {source}" if isinstance(source, Circuit) else model_title(source),
            [charts, data_section, residuals],
            "",
            verdict_box(self.verdict if validation is None else validation.verdict),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the result as a dictionary for JSON."""
        if isinstance(self.system, Circuit):
            contents: dict[str, Any] = {"circuit": str(self.system)}
        else:
            contents = {"equations": [str(e) for e in self.system.equations]}
        names = ("weights", "values", "standard_errors", "intervals", "chi_squared", "errors", "converged")
        starts = {"starts": list(self.start_counts)}
        return (
            contents
            | attributes(self, names)
            | starts
            | attributes(self, ("white", "information", "findings", "warnings"))
        )

    def __str__(self) -> str:
        return self.summary()

    def _repr_html_(self) -> str:
        charts = Markup("").join(Markup(f._repr_html_()) for f in self.figures())
        return str(verdict_html(self.verdict) + self._equations_html() + self._parameter_table().to_html() + charts)

    def _equations_html(self) -> Markup:
        """Return the equations or the circuit as HTML."""
        from ftlm.report.typesetting import equation_html

        if isinstance(self.system, Circuit):
            return Markup("<p>{}</p>").format(str(self.system).replace("-", " − "))
        delay = self.system.structure.delay
        lines = (Markup("<p>{}</p>").format(equation_html(e, delay)) for e in self.system.equations)
        return Markup("").join(lines)

    def _parameter_table(self) -> Table:
        """Return the table of the parameters with their intervals."""
        from ftlm.report.typesetting import parameter_table

        if isinstance(self.system, Model):
            return parameter_table(self.system)
        rows: list[list[Cell]] = []
        for p in self.parameters.values():
            finite_values = [v if math.isfinite(v) else None for v in (p.standard_error, *p.interval)]
            rows.append([p.name, p.value, *finite_values, p.unit])
        return Table("Parameters", ("name", "value", "standard error", "95 % from", "to", "unit"), rows)


def assign_signals(model: Model | Circuit, record: FrequencyData) -> FrequencyData:
    """Return a record with the output and input names of a model; raise DataError if the model lacks one of them.

    A name that the record lacks is filled in if the model has only one such signal.
    """
    if isinstance(model, Circuit):
        return replace(record, output=record.output or "U", input=record.input or "I", unit=record.unit or "Ω")
    inputs = response_inputs(model, coupled=True)
    out = {"output": record.output, "input": record.input}
    for side, names in (("output", model.outputs), ("input", inputs)):
        if not out[side] and len(names) == 1:
            out[side] = names[0]
        if out[side] not in names:
            raise DataError(
                f"{record.name} has the {side} {out[side]!r}, and the model {', '.join(names)}; give "
                f"{parameter(side)} when loading it"
            )
    return replace(record, output=out["output"], input=out["input"])


def error_of(model: Model | Circuit, record: FrequencyData) -> ResponseError:
    """Return the relative error of a model on one measured frequency response."""
    magnitude = np.abs(record.response)
    relative_errors = np.abs(model_response(model, record, record.frequency) - record.response) / np.where(
        magnitude > 0, magnitude, np.max(magnitude) or 1.0
    )
    at = int(np.argmax(relative_errors))
    rms = 100 * float(np.sqrt(np.mean(relative_errors**2)))
    return ResponseError(
        record.name, record.output, record.input, rms, 100 * float(relative_errors[at]), float(record.frequency[at])
    )


def _large_error_findings(errors: Sequence[ResponseError]) -> list[Finding]:
    """Return a finding on each response on which the relative error of the model exceeds `MAX_RELATIVE_ERROR`."""
    return [
        make_finding("response_missed", run=e.name, output=e.output, input=e.input, rms=e.rms)
        for e in errors
        if not e.rms <= 100 * MAX_RELATIVE_ERROR
    ]


def _fit_of(errors: Sequence[ResponseError]) -> dict[str, float]:
    """Return 100 minus the root mean square of the relative errors in percent, by output."""
    squares: dict[str, list[float]] = {}
    for error in errors:
        squares.setdefault(error.output, []).append(error.rms**2)
    return {output: 100.0 - math.sqrt(sum(terms) / len(terms)) for output, terms in squares.items()}


def _errors_in_words(errors: Sequence[ResponseError]) -> list[str]:
    lines = ["error over the size of the measured response"]
    for e in errors:
        lines.append(
            f"  {e.output} from {e.input} ({e.name}): {e.rms:.3g} % rms, at most {e.largest:.3g} % at {e.at:.4g} rad/s "
            f"({e.at / (2.0 * math.pi):.4g} Hz)"
        )
    return lines


def _error_row(label: str, error: ResponseError) -> list[Cell]:
    pair = f"{error.output} from {error.input}"
    return [
        label,
        error.name,
        pair,
        number(error.rms, 3),
        number(error.largest, 3),
        number(error.at / (2.0 * math.pi), 4),
    ]
