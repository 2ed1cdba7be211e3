"""Loading of frequency responses and impedance spectra from analyzer and potentiostat files."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ftlm.data.frequency_data import FREQUENCY_UNITS, FrequencyData, frequency_factor
from ftlm.data.units import SIGNAL_UNITS, parse_unit
from ftlm.errors import DataError
from ftlm.io.cell_parsing import split_unit
from ftlm.io.dialect import Layout
from ftlm.io.load import PathLike, base_name, read_tables
from ftlm.io.table import Column, ColumnTable
from ftlm.utils.arguments import check_arguments
from ftlm.utils.files import PACKAGE_LOGGER
from ftlm.utils.parameters import PART_COLUMNS, parameter, type_name
from ftlm.utils.validation import Complex, Floats, join_names, nearest

#: Words for each part of a response, alone or combined with the letter z, h or g, as in ``zreal`` and ``im(z)``.
_PART_WORDS = {
    "real": ("re", "real"),
    "imag": ("im", "imag", "img", "imaginary"),
    "magnitude": ("abs", "mag", "mod"),
    "phase": ("phase", "arg"),
}
#: Column names of each part, case-folded, without spaces and underscores; a leading minus inverts the sign.
_PART_SYNONYMS = {
    part: (
        *names.split(),
        *_PART_WORDS.get(part, ()),
        *(
            form.format(q, w)
            for w in _PART_WORDS.get(part, ())
            for q in "zhg"
            for form in ("{0}{1}", "{1}{0}", "{1}({0})")
        ),
    )
    for part, names in {
        "frequency": "f freq frequency frequenz fréquence frecuencia frequenza hz w omega ω angularfrequency "
        "kreisfrequenz rad/s",
        "real": "realpart realteil z' z′ z’ zr z'(a)",
        "imag": "imagpart imaginarypart imaginärteil imaginaerteil z'' z″ z′′ zi z''(b) z’’",
        "magnitude": "magnitude gain amplitude betrag verstärkung verstaerkung modulus |z| |h| |g| amp z db "
        "impedance amplitudengang",
        "phase": "phi φ ϕ angle winkel zphz phz theta θ deg ° phasenwinkel phasengang",
        "deviation": "std sigma σ deviation stddev sd stdev standarddeviation standardabweichung",
    }.items()
}
_ANGULAR_FREQUENCY_NAMES = frozenset(("w", "omega", "ω", "angularfrequency", "kreisfrequenz", "rad/s"))
_MINUS_PREFIX_PATTERN = re.compile(r"^(?:-|−|–|neg|minus)")
#: Ohm sign, which looks like the Greek letter Omega.
_OHM_SIGN = "\u2126"
_SI_PREFIX_FACTORS = {"": 1.0, "m": 1e-3, "k": 1e3, "M": 1e6, "µ": 1e-6, "u": 1e-6, "G": 1e9}
_PHASE_UNITS = ("deg", "rad", "mrad")
_DIMENSIONLESS_UNITS = ("", "1", "-", "abs", "lin", "linear")
#: Maximum length of column names that are compared with the names of parts.
_MAX_PART_NAME_CHARACTERS = 60
#: Minimum number of rows of a sweep. Fewer rows are single frequencies that an instrument repeats as a check.
MIN_SWEEP_ROWS = 3
#: Maximum relative difference of a magnitude column from the magnitude of real and imaginary part in the same file.
_MAGNITUDE_TOLERANCE = 0.02


#: Parts of a response in a file of three columns without a header line, as potentiostats export it.
HEADERLESS_PARTS = ("frequency", "real", "imag")


@dataclass(frozen=True)
class _ResponseColumn:
    """Column of a frequency response.

    Parameters
    ----------
    column
        Column of the file.
    part
        Part of the response: "frequency", "real", "imag", "magnitude", "phase" or "deviation".
    unit
        Unit in the file; "" if there is none.
    is_negated
        Whether the name of the column inverts the sign, as in ``-Z''``.
    word
        Name of the column without unit and sign.
    """

    column: Column
    part: str
    unit: str
    is_negated: bool
    word: str


@check_arguments
def load_frequency(
    path: PathLike,
    *,
    columns: Mapping[str, str | int] | None = None,
    frequency_unit: str | None = None,
    magnitude_unit: str | None = None,
    phase_unit: str | None = None,
    negated: bool | None = None,
    output: str = "",
    input: str = "",
    name: str | None = None,
    layout: Layout | Mapping[str, object] | None = None,
) -> FrequencyData:
    """Load a frequency response or an impedance spectrum from a text file or a sheet.

    Parameters
    ----------
    path
        File of any format that :func:`ftlm.load` reads.
    columns
        Name or position of the column of each part: ``frequency``; ``real`` and ``imag``, or ``magnitude`` and
        ``phase``; ``deviation``, the standard deviation of the real and of the imaginary part. By default, columns are
        recognized by their names: ``freq``, ``f``, ``omega``; ``Re``, ``Zreal``, ``Z'``; ``Im``, ``Zimag``, ``Z''`` and
        ``-Z''``, ``-Im(Z)`` (the sign inverted); ``|Z|``, ``gain``, ``magnitude``, ``dB``; ``phase``, ``deg``;
        ``sigma``. Three columns without names are ``frequency``, ``real`` and ``imag``, with a warning.
    frequency_unit
        ``"Hz"``, ``"kHz"``, ``"MHz"``, ``"mHz"`` or ``"rad/s"``. By default the unit in the column name, such as
        ``freq/Hz``, ``f [Hz]`` or ``f_Hz``; without one, rad/s for a column called omega and Hz for others, with a
        warning.
    magnitude_unit
        ``"dB"`` or ``"abs"``; by default the unit of the column, or ``"abs"`` with a warning.
    phase_unit
        ``"deg"`` or ``"rad"``; by default the unit of the column, or ``"deg"`` with a warning.
    negated
        Whether the file has the negative imaginary part (or phase). The default is True if the name of this column
        begins with a minus sign, otherwise False.
    output, input
        Names of the output and the input; "" (default) means the only output or input of the structure.
    name
        Name of the data in reports; default the name of the file.
    layout
        See :class:`ftlm.Layout`.

    Returns
    -------
    FrequencyData
        Data with frequencies in rad/s and impedances in Ω; `warnings` lists the assumptions.

    Raises
    ------
    DataError
        If the file cannot be read, columns are not recognized or have no numbers, a unit is unknown, or a frequency is
        not positive.
    """
    (table,) = read_tables(path, Layout.from_argument(layout))
    pool = ColumnTable([table])
    if table.header is not None:
        raise DataError(f"{table.path.name} is a run over time that ftlm wrote; load it with ftlm.load")
    notes = [str(a) for a in table.assumptions if a.affects_run]
    if columns is None and table.layout.header == 0 and len(pool.columns) == len(HEADERLESS_PARTS):
        columns = dict(zip(HEADERLESS_PARTS, pool.names, strict=True))
        way_out = parameter("columns", PART_COLUMNS)
        notes.append(f"no line of names: the columns are taken as {join_names(HEADERLESS_PARTS)}; otherwise {way_out}")
    parts = _select_parts(pool, columns) if columns is not None else _find_parts(pool)
    omega = _frequencies(parts["frequency"], frequency_unit, notes)
    factor, unit = 1.0, ""
    if "real" in parts and "imag" in parts:
        if magnitude_unit is not None or phase_unit is not None:
            which = "magnitude_unit" if magnitude_unit is not None else "phase_unit"
            raise DataError(f"{parameter(which)} is not used: the file gives real and imaginary part; leave it out")
        response, factor, unit = _cartesian(parts, negated, notes)
        if "magnitude" in parts:
            _compare(parts, response / factor, notes)
    else:
        response, factor, unit = _polar(parts, magnitude_unit, phase_unit, negated, notes)
    deviation = None
    if "deviation" in parts:
        deviation = factor * parts["deviation"].column.numbers().astype(np.float64)
    label = base_name(table.path) if name is None else name
    is_zero_frequency = omega == 0.0
    if np.any(is_zero_frequency) and not np.all(is_zero_frequency):
        # Some instruments append a row at 0 Hz, which has no place on a logarithmic axis.
        notes.append(f"{int(np.sum(is_zero_frequency))} of {omega.size} rows are at frequency 0 and left out")
        omega, response = omega[~is_zero_frequency], response[~is_zero_frequency]
        deviation = None if deviation is None else deviation[~is_zero_frequency]
    notes += _describe_sweeps(omega, response)
    PACKAGE_LOGGER.info("read: %s: %d frequencies", label, omega.size)
    return FrequencyData(omega, response, deviation, output, input, unit, label, tuple(notes))


def _describe_sweeps(omega: Floats, response: Complex) -> list[str]:
    """Return a note on the relative difference between repeated sweeps; [] if the rows are one sweep.

    A sweep is a contiguous block of rows with increasing or decreasing frequencies. In the common frequency range, each
    later sweep is compared with the first sweep, which is interpolated linearly over the logarithm of the frequency.
    """
    directions = np.sign(np.diff(omega))
    reversals = np.flatnonzero(directions == -np.sign(np.sum(directions))) + 1
    sweeps = [rows for rows in np.split(np.arange(omega.size), reversals) if rows.size >= MIN_SWEEP_ROWS]
    differences = []
    for rows in sweeps[1:]:
        first_sweep = sweeps[0][np.argsort(omega[sweeps[0]], kind="stable")]
        shared_rows = rows[(omega[rows] >= omega[first_sweep[0]]) & (omega[rows] <= omega[first_sweep[-1]])]
        if shared_rows.size >= MIN_SWEEP_ROWS:
            at, known_points = np.log(omega[shared_rows]), np.log(omega[first_sweep])
            curve = np.interp(at, known_points, response[first_sweep].real) + 1j * np.interp(
                at, known_points, response[first_sweep].imag
            )
            differences.append(float(np.linalg.norm(response[shared_rows] - curve) / np.linalg.norm(curve)))
    if not differences:
        return []
    return [
        f"the file has {len(differences) + 1} sweeps over its frequencies, read as one response; they differ from the "
        f"first by up to {100 * max(differences):.2g} %: give each sweep a file of its own if the object changed"
    ]


def is_response(pool: ColumnTable) -> bool:
    """Whether the column names are those of a frequency response, so that no argument is needed to load it."""
    try:
        _find_parts(pool)
    except DataError:
        return False
    return True


def _find_parts(pool: ColumnTable) -> dict[str, _ResponseColumn]:
    """Return the columns of a frequency response by part; raise DataError if a part is ambiguous or missing."""
    parts: dict[str, _ResponseColumn] = {}
    for column in pool.columns:
        item = _recognize_column(column)
        if item is None:
            continue
        if item.part in parts:
            raise DataError(
                f"the columns {parts[item.part].column.name!r} and {column.name!r} may both be the {item.part}; name "
                f"one with {parameter('columns', PART_COLUMNS)}"
            )
        parts[item.part] = item
    _check_parts(parts, pool)
    return parts


def _select_parts(pool: ColumnTable, columns: Mapping[str, str | int]) -> dict[str, _ResponseColumn]:
    if not isinstance(columns, Mapping):
        raise DataError(f"columns is {type_name(columns)}; pass a dict of part: column")
    parts = {}
    for part, spec in columns.items():
        if part not in _PART_SYNONYMS:
            raise DataError(
                f"{part!r} is not part of a frequency response{nearest(part, _PART_SYNONYMS)}; the parts are "
                f"{join_names(_PART_SYNONYMS)}"
            )
        column = pool.find(spec, part)
        item = _recognize_column(column)
        word, unit = (item.word, item.unit) if item is not None else _split_name_and_unit(column)
        parts[part] = _ResponseColumn(column, part, unit, item is not None and item.is_negated, word)
    _check_parts(parts, pool)
    return parts


def _check_parts(parts: Mapping[str, _ResponseColumn], pool: ColumnTable) -> None:
    is_complete = {"real", "imag"} <= parts.keys() or {"magnitude", "phase"} <= parts.keys()
    if "frequency" in parts and is_complete:
        return
    names = ", ".join(f"{i.part} {i.column.name!r}" for i in parts.values()) or "none"
    missing_text = "the frequency" if "frequency" not in parts else "real and imaginary part, or magnitude and phase"
    raise DataError(
        f"{missing_text} cannot be recognized by column names (recognized: {names}); name the columns with "
        f"{parameter('columns', PART_COLUMNS)}, parts frequency, real and imag, or frequency, magnitude and phase; "
        f"{pool.describe()}"
    )


def _split_name_and_unit(column: Column) -> tuple[str, str]:
    """Split a column name such as ``freq/Hz``, ``f_Hz`` or ``f (Hz)`` into name and unit."""
    bare, unit = split_unit(column.name_with_unit)
    if unit:
        return bare, unit
    bare, unit = column.name.strip(), column.file_unit
    if unit:
        return bare, unit
    if bare.casefold().endswith("_rad_s"):
        return bare[:-6], "rad/s"
    for character in ("/", "_", " ", ","):
        head, separator, tail = bare.rpartition(character)
        if separator and head and _unit_kind(tail.strip()) is not None:
            return head.strip(), tail.strip()
    return bare, ""


def _unit_kind(unit: str) -> str | None:
    """Return the quantity that a unit measures: ``frequency``, ``phase`` or ``size``; None if unknown."""
    if unit in FREQUENCY_UNITS or unit.casefold() in ("hz", "rad/s", "khz", "rad/sec", "1/s"):
        return "frequency"
    if _phase_unit(unit) is not None:
        return "phase"
    if unit.casefold() in ("db", "abs") or _ohms(unit) is not None:
        return "size"
    return None


def _phase_unit(unit: str) -> str | None:
    """Return ``"deg"`` or ``"rad"`` for the unit of a phase; None for other units."""
    unit_name = parse_unit(unit.casefold())
    return "deg" if unit_name == "°" else unit_name if unit_name in _PHASE_UNITS else None


def _recognize_column(column: Column) -> _ResponseColumn | None:
    """Return a column of a response with the part that its name denotes, such as ``Re(Z)`` or ``dB``; else None."""
    full_name, file_unit = column.name.strip(), column.file_unit
    name_unit = full_name if _unit_kind(full_name) else file_unit if _unit_kind(file_unit) else ""
    for text, unit in ((full_name, name_unit), _split_name_and_unit(column)):
        word = re.sub(
            r"[\s_]", "", text.replace(_OHM_SIGN, "Ω") if len(text) < _MAX_PART_NAME_CHARACTERS else ""
        ).casefold()
        word = word.replace('"', "''")
        bare = _MINUS_PREFIX_PATTERN.sub("", word)
        for name, is_negated in ((word, False), (bare, True)):
            part = next((p for p, names in _PART_SYNONYMS.items() if name in names), None)
            if part is not None:
                return _ResponseColumn(column, part, unit, is_negated, name)
    return None


def _frequencies(item: _ResponseColumn, option: str | None, notes: list[str]) -> Floats:
    values = item.column.numbers().astype(np.float64)
    file_unit = item.unit if _unit_kind(item.unit) == "frequency" else ""
    if file_unit and file_unit not in FREQUENCY_UNITS:
        folded = {"hz": "Hz", "khz": "kHz", "rad/s": "rad/s", "rad/sec": "rad/s", "1/s": "rad/s"}
        file_unit = folded[file_unit.casefold()]
    if option is not None:
        frequency_factor(option)
        if file_unit and file_unit != option:
            raise DataError(
                f"column {item.column.name!r} states {file_unit}, and {parameter('frequency_unit', option)} is "
                f"given; leave {parameter('frequency_unit')} out, or rename the column"
            )
    unit = option or file_unit
    if not unit:
        if item.unit:
            raise DataError(
                f"column {item.column.name!r} states the unit {item.unit!r}, which is not a unit of frequency; give "
                f"{parameter('frequency_unit')}, one of {', '.join(FREQUENCY_UNITS)}"
            )
        unit = "rad/s" if item.word in _ANGULAR_FREQUENCY_NAMES else "Hz"
        notes.append(
            f"frequencies {item.column.name!r} are assumed to be in {unit}; otherwise {parameter('frequency_unit')}"
        )
    return values * FREQUENCY_UNITS[unit]


def _ohms(unit: str) -> float | None:
    """Return the factor that converts an impedance unit, such as mΩ, to Ω; None for other units."""
    text = unit.replace(_OHM_SIGN, "Ω")
    for ending in ("ohm", "Ohm", "OHM", "ohms", "Ohms", "Ω", "ω"):
        if text.endswith(ending) and text[: -len(ending)] in _SI_PREFIX_FACTORS:
            return _SI_PREFIX_FACTORS[text[: -len(ending)]]
    return None


def _magnitude_scale(item: _ResponseColumn) -> tuple[float, str]:
    """Return (conversion factor to SI, SI unit) of a magnitude; the unit is "" if dimensionless or not stated."""
    if not item.unit or item.unit.casefold() in _DIMENSIONLESS_UNITS:
        return 1.0, ""
    factor = _ohms(item.unit)
    return (factor, "Ω") if factor is not None else (1.0, item.unit)


def _cartesian(
    parts: Mapping[str, _ResponseColumn], negated: bool | None, notes: list[str]
) -> tuple[Complex, float, str]:
    real, imag = parts["real"], parts["imag"]
    factor, unit = _magnitude_scale(real)
    imag_scale, _ = _magnitude_scale(imag)
    if (factor, unit) != _magnitude_scale(imag) and imag.unit and real.unit:
        raise DataError(
            f"columns {real.column.name!r} and {imag.column.name!r} have the units {real.unit!r} and {imag.unit!r}; "
            "give both in one unit"
        )
    factor = factor if real.unit else imag_scale
    is_negated = imag.is_negated if negated is None else _truth("negated", negated)
    x, y = (i.column.numbers().astype(np.float64) for i in (real, imag))
    if is_negated and negated is None:
        notes.append(
            f"column {imag.column.name!r} contains the negative imaginary part, by its name; otherwise "
            f"{parameter('negated')}"
        )
    elif negated is None and imag.word.startswith("z") and np.mean(y > 0) > 0.5:
        notes.append(
            f"the imaginary part {imag.column.name!r} is positive in {int(np.sum(y > 0))} of {y.size} rows, as of an "
            f"inductance; if it contains -Z'', give {parameter('negated', True)}"
        )
    response: Complex = np.asarray(factor * (x - 1j * y if is_negated else x + 1j * y), dtype=np.complex128)
    return response, factor, unit or _magnitude_scale(imag)[1]


def _polar(
    parts: Mapping[str, _ResponseColumn],
    magnitude_unit: str | None,
    phase_unit: str | None,
    negated: bool | None,
    notes: list[str],
) -> tuple[Complex, float, str]:
    magnitude, angle = parts["magnitude"], parts["phase"]
    values, phase = (i.column.numbers().astype(np.float64) for i in (magnitude, angle))
    file_unit = "dB" if magnitude.unit.casefold() == "db" else "abs" if magnitude.unit else None
    decibels = _resolve_unit("magnitude", magnitude, magnitude_unit, ("abs", "dB"), file_unit, notes)
    if decibels == "dB" and "deviation" in parts:
        raise DataError(
            f"column {parts['deviation'].column.name!r} is read as the standard deviation of real and imaginary "
            "part, which does not apply to magnitudes in dB; give real and imaginary part, or name the columns with "
            f"{parameter('columns', PART_COLUMNS)}"
        )
    file_unit = _phase_unit(angle.unit)
    radians = SIGNAL_UNITS[_resolve_unit("phase", angle, phase_unit, _PHASE_UNITS, file_unit, notes)][1]
    factor, unit = (1.0, "") if decibels == "dB" else _magnitude_scale(magnitude)
    if decibels == "dB":
        values = 10.0 ** (values / 20.0)
    elif np.any(values < 0):
        is_negative = values < 0
        raise DataError(
            f"column {magnitude.column.name!r}: a magnitude is negative, first at row {int(np.argmax(is_negative))}, "
            f"{int(is_negative.sum())} in all; give {parameter('magnitude_unit', 'dB')} if these are decibels"
        )
    is_negated = angle.is_negated if negated is None else _truth("negated", negated)
    if is_negated and negated is None:
        notes.append(
            f"column {angle.column.name!r} contains the negative phase, by its name; otherwise {parameter('negated')}"
        )
    response: Complex = factor * values * np.exp((-1j if is_negated else 1j) * radians * phase)
    return response, factor, unit


def _resolve_unit(
    kind: str, item: _ResponseColumn, option: str | None, choices: tuple[str, ...], unit: str | None, notes: list[str]
) -> str:
    """Return the unit of a column: the option of the user, else the unit in the file, else the first of `choices`.

    `kind` is "magnitude" or "phase". If the unit is assumed, a note is added to `notes`. Raise DataError if the option
    is unknown or contradicts the file.
    """
    if option is not None:
        if option not in choices:
            hint = nearest(option, choices)
            raise DataError(
                f"{parameter(f'{kind}_unit', option)} is unknown{hint}; the known ones are {join_names(choices)}"
            )
        if unit is not None and unit != option:
            raise DataError(
                f"column {item.column.name!r} states {unit}, and {parameter(f'{kind}_unit', option)} is given; "
                f"leave {parameter(f'{kind}_unit')} out, or rename the column"
            )
        return option
    if unit is not None:
        return unit
    default_text = "linear, not in decibels" if kind == "magnitude" else "in degrees"
    notes.append(
        f"the {kind} {item.column.name!r} is assumed to be {default_text}; otherwise "
        f"{parameter(f'{kind}_unit', choices[1])}"
    )
    return choices[0]


def _truth(name: str, value: object) -> bool:
    if not isinstance(value, bool):
        raise DataError(f"{parameter(name)}{value!r} is neither True nor False; give one of them")
    return value


def _compare(parts: Mapping[str, _ResponseColumn], response: Complex, notes: list[str]) -> None:
    """Add a note to `notes` if a redundant magnitude column differs from the magnitude of the response by over 2 %."""
    item = parts["magnitude"]
    if item.unit.casefold() == "db" or item.column.problem is not None:
        return
    values, units = item.column.numbers(), _ohms(item.unit) or 1.0
    scale = (_ohms(parts["real"].unit) or 1.0) / units
    off = np.abs(np.abs(response) * scale - values) > _MAGNITUDE_TOLERANCE * np.abs(values)
    if np.any(off):
        notes.append(
            f"column {item.column.name!r} is not the magnitude of real and imaginary part, first at row "
            f"{int(np.argmax(off))}, {int(off.sum())} in all; real and imaginary part were used"
        )
