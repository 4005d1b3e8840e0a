"""Lines and tables that people read: how they are declared, and words and rows that command line and report share.

It imports nothing that computes, so that ``--help`` and ``show`` are quick.

Example:
    >>> rows = [{"socket": "A", "rms_mm": 0.01234}, {"socket": "B", "rms_mm": None}]
    >>> listed("Sockets", rows, {"socket": "socket", "RMS [mm]": "rms_mm"}).rows
    [['A', 0.01234], ['B', None]]
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from numbers import Integral
from typing import Any, NamedTuple

from ..core.text import MODEL_CHOSEN, pluralise
from ..core.units import DEG, people_read, people_read_change
from ..uncertainty.shared_kinds import PLACES, SUCCESSIVE, VISITS

_MOST_DECIMALS = 6  # of a quantity that was found
_MOST = 1e9  # from here on decimals mean nothing
_ZERO = 1e-9  # mm: smaller numbers are rounding errors
STYLES = {"good": "green", "unsure": "yellow", "bad": "red", "outlier": "red"}  # of marks on the terminal

# Repeatability and errors of lengths, by their keys in a summary.
METRICS = (
    ("de_mm", "DE, mean distance of poses from their socket's centroid"),
    ("deltam_mm", "Deltam, largest half range of a coordinate in a socket"),
    ("rms_mm", "RMS distance of poses from their socket's centroid"),
    ("distance_largest_mm", "largest distance of a pose from its socket's centroid"),
    ("observed_rms_mm", "RMS distance of poses from their geometry, all kinds"),
    ("observed_mean_mm", "mean distance of poses from their geometry, all kinds"),
    ("observed_largest_mm", "largest distance of a pose from its geometry, all kinds"),
    ("length_error_mean_absolute_mm", "length error, mean absolute"),
    ("length_error_largest_mm", "length error, largest"),
)


class Styled(NamedTuple):
    """A text in a style of the terminal, such as "red"."""

    text: str
    style: str = "bold"


class Cell(NamedTuple):
    """A number that is shown with decimals of its own, or a text that is marked."""

    text: str
    value: float | None = None  # what a column is sorted by; None: the text
    mark: str = ""  # "good", "bad", "unsure", "outlier"


Line = str | Styled | Sequence[str | Styled]
Columns = Mapping[str, str | Callable[[Any], Any] | None]


class Table(NamedTuple):
    """A table: a cell is a text, a number (of mm, with four decimals), a `Cell`, or None for what there is not."""

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[Any]]
    folded: bool = False  # a page shows it on demand only, and does not print it

    @property
    def cells(self) -> list[list[Cell]]:
        """All cells as a page shows them."""
        return [[_cell(cell) for cell in row] for row in self.rows]


View = Iterator[Line | Table]  # what people see of a summary


def listed(title: str, rows: Iterable[Any], columns: Columns | Sequence[str]) -> Table:
    """A table of rows: each column is a key of the row, or a function of the row; None: there is no such column.

    With headings alone, each row is its cells.
    """
    if not isinstance(columns, Mapping):
        return Table(title, columns, list(rows))
    getters = {heading: getter for heading, getter in columns.items() if getter is not None}
    cells = [
        [getter(row) if callable(getter) else row.get(getter) for getter in getters.values()]
        for row in rows
    ]  # fmt: skip
    return Table(title, list(getters), cells)


def by_columns(title: str, columns: Mapping[str, Iterable[Any]]) -> Table:
    """A table of columns that are known as a whole: heading -> the cells from above."""
    return Table(title, list(columns), list(zip(*columns.values(), strict=True)))


def plain(value: Any) -> Any:
    """A value as JSON can hold it: arrays and sequences as lists, and None for what is not finite."""
    if isinstance(value, Mapping):
        return {key: plain(part) for key, part in value.items()}
    value = value.tolist() if hasattr(value, "tolist") else value  # of NumPy and JAX
    if isinstance(value, list | tuple | range):
        return [plain(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def attributes(item: Any, *names: str, **renamed: str) -> dict[str, Any]:
    """Attributes of a record, under their own names or others (key="attribute"), as JSON can hold them."""
    keys = {name: name for name in names} | renamed
    return {key: plain(getattr(item, name)) for key, name in keys.items()}


def rows_of(**columns: Any) -> list[dict[str, Any]]:
    """A dictionary for each row of columns that are known as a whole, with values as JSON can hold them."""
    return [dict(zip(columns, row, strict=True)) for row in zip(*map(plain, columns.values()), strict=True)]


def _cell(cell: Any) -> Cell:
    if isinstance(cell, Cell):
        return cell
    if isinstance(cell, bool):
        return Cell("yes" if cell else "no")
    return Cell(cell) if isinstance(cell, str) else number(cell, 0 if isinstance(cell, Integral) else 4)


def number(
    value: float | None, decimals: int = 4, *, signed: bool = False, mark: str = "", rounded: bool = False
) -> Cell:
    """A cell with a number; a dash for None and NaN. ``rounded``: to these decimals of its U, even to 0."""
    if value is None or not math.isfinite(value):
        return Cell("–" if value is None or math.isnan(value) else "not determined", None, mark)
    shown = round(value, decimals) if rounded else value
    return Cell(format_number(shown, decimals, signed=signed), float(value), mark)


def numbers(values: Iterable[float], decimals: int = 4) -> list[Cell]:
    """A cell for each number of an array."""
    return [number(float(value), decimals) for value in values]


def format_number(value: float, decimals: int = 4, *, signed: bool = False) -> str:
    """A number with a fixed number of decimals, or in powers of ten if these would not show it; with a true minus."""
    sign = "+" if signed else ""
    if abs(value) < _ZERO:
        value = 0.0
    if not abs(value) < _MOST:
        return f"{value:{sign}.6g}".replace("-", "−")
    small = value != 0 and abs(value) < 0.5 * 10**-decimals
    return (f"{value:{sign}.1e}" if small else f"{value:{sign}.{decimals}f}").replace("-", "−")


def formatted(value: float | None) -> str:
    """A number in a line of the terminal."""
    return "-" if value is None else format_number(value).replace("−", "-")


def two_digits(u: float) -> str:
    """An uncertainty to two digits: 0.0123 is "0.012"."""
    return f"{u:.{decimals_for(u)}f}"


def decimals_for(u: float | None, default: int = 4) -> int:
    """Decimals that show two digits of an uncertainty, and that its value is rounded to."""
    if u is None or not math.isfinite(u) or u <= 0:
        return default
    # 0.0996 is 0.10 and not 0.100.
    return min(max(1 - math.floor(math.log10(float(f"{u:.1e}"))), 0), 9)


def warnings_of(summary: Mapping[str, Any], lead: str = "Warning:", key: str = "warnings") -> list[Line]:
    """What a user should know before the numbers."""
    return [[Styled(lead, "yellow"), f" {warning}"] for warning in summary.get(key, ())]


def decided_of(summary: Mapping[str, Any]) -> Iterator[str]:
    """What was decided by default; and of the choice of a model, which figure to state instead of those it names."""
    stated = "line Held out" if "held_out_poses" in summary else "table Cross-validation"
    for decision in summary["decisions"]:
        yield f"Decided by default: {decision}"
        if summary["cross_validation"] is not None and decision.startswith(MODEL_CHOSEN):
            yield (
                "These figures of held-out regions only compare models: a region is one group, or half of a joint's "
                "travel, and a frame or target that other poses share is not fitted to it again. State the figure of "
                f"the {stated}."
            )


def verdict_of(summary: Mapping[str, Any]) -> list[Line]:
    """What a result is good for, in one line."""
    verdict = summary.get("verdict")
    return [Styled(verdict["says"], STYLES.get(verdict["mark"], "bold"))] if verdict else []


def limits_of(summary: Mapping[str, Any]) -> list[Line]:
    """Limits that are kept, those that are exceeded, and those that the data do not decide on."""
    words = {"kept": ("Passed:", "green"), "failed": ("Failed:", "red"), "undecided": ("Undecided:", "yellow")}
    return [[Styled(*words[key]), f" {sentence}"] for key in words for sentence in summary.get(key, ())]


def written_of(summary: Mapping[str, Any]) -> list[Line]:
    """The file that was written, where there is one."""
    return [f"\nWritten: {summary['written']}"] if "written" in summary else []


def observed_words(sockets: int, others: int, lengths: int | None = None) -> str:
    """How many sockets, other observations and reference lengths there are; those of which there are none are left
    out where something else is left to name."""
    words = [pluralise(sockets, "socket")] if sockets or not others else []
    if others:
        words.append(pluralise(others, "other observation" if sockets else "observation"))
    if lengths or (lengths is not None and not others):
        words.append(pluralise(lengths, "reference length"))
    return ", ".join(words)


def quantity_words(row: Mapping[str, Any], u: bool = True, coverage: float | None = None) -> str:
    """A quantity of an observation as a person reads it, angles in deg; with its standard uncertainty where one is
    stated and ``u`` is true. With a coverage factor, what was found is rounded to its expanded uncertainty."""
    factor, unit = people_read(row["unit"])
    uncertainties = [None] * len(row["values"]) if coverage is None else row["u_found"]
    expanded = [None if value is None else (coverage or 0.0) * factor * value for value in uncertainties]
    decimals = [min(decimals_for(u, 4 if unit else 6), _MOST_DECIMALS) for u in expanded]
    pairs = zip(row["values"], decimals, strict=True)
    words = _in_brackets([f"{factor * value:z.{digits}f}" for value, digits in pairs], unit)
    if not u or row["u"] is None:
        return words
    return f"{words} (exact)" if row["u"] == 0 else f"{words} (u = {factor * row['u']:.4g} {unit or 1})"


def expanded_words(row: Mapping[str, Any], coverage: float) -> str:
    """The expanded uncertainties of a quantity that was found, two digits each, angles in deg."""
    factor, unit = people_read(row["unit"])
    if any(u is None for u in row["u_found"]):
        return "not determined"
    return _in_brackets([two_digits(coverage * factor * u) if u > 0 else "0" for u in row["u_found"]], unit)


def _in_brackets(words: Sequence[str], unit: str) -> str:
    return (f"({', '.join(words)})" if len(words) > 1 else words[0]) + (f" {unit}" if unit else "")


def factor_words(volume: Mapping[str, Any]) -> str:
    """The coverage factors over the working volume: each length has its own."""
    low, high = (volume[f"coverage_factor_{end}"] for end in ("least", "largest"))
    if low is None or high is None:
        return ""
    return f"coverage factor {low:.2f}" + (f" to {high:.2f}" if f"{low:.2f}" != f"{high:.2f}" else "")


def noise_sentence(summary: Mapping[str, Any]) -> str:
    """The noise that the uncertainties of a calibration rest on."""

    def joined(values: float | list[float], factor: float) -> str:
        return ", ".join(f"{factor * x:.3g}" for x in (values if isinstance(values, list) else [values]))

    part = summary["uncertainty"]
    linear, seating = part["linear_encoder_mm"], f"{1e3 * part['seating_mm']:.3g} um"
    slides = "" if linear is None else f", linear encoders {joined(linear, 1e3)} um"
    # What does not come from the joints is of the seat in a socket, or of the tip itself.
    seat = "seat" if summary["sockets_used"] else "each coordinate of the tip"
    noise = f"encoders {joined(part['encoder_arcsec'], 1.0)} arcsec{slides}, {seat} {seating}"
    joints = ", ".join(str(row["joint"]) for row in part.get("noisy_encoders", ()))
    replaced = f", except for joint {joints}" if joints else ""
    return {
        "given": f"Noise as given{replaced}: {noise}; residuals are {part['misfit'] or 0:.2f} times as large as this "
        "noise predicts.",
        "estimated": f"Noise estimated from the residuals: {noise} (only their combination is well determined).",
        "common": f"The same noise for all poses: {seating} per coordinate.",
        "robust": "The variance of each pose is estimated from the residual of this pose (robust noise model).",
    }[part["form"]]


# Unit of residuals that are not lengths -> the key of their root mean square.
OTHER_RMS = {"rad": "rms_angle_rad", "px": "rms_px"}


def other_rms_columns(rows: Sequence[Mapping[str, Any]], title: str) -> dict[str, Any]:
    """Columns with the root mean squares of residuals that are not lengths, in the units that people read; only of
    units in which something was measured."""
    present = {unit: key for unit, key in OTHER_RMS.items() if any(row.get(key) is not None for row in rows)}
    return {f"{title} [{people_read(unit)[1]}]": partial(in_read_unit, unit, key) for unit, key in present.items()}


def in_read_unit(unit: str, key: str, row: Mapping[str, Any]) -> "Cell":
    """A value of a row in the unit in which people read it; nothing where the row has none."""
    value = row.get(key)
    return number(None if value is None else people_read(unit)[0] * value)


def lengths_sentence(row: Mapping[str, Any]) -> str:
    """What a calibration says of the lengths that it was tried on (`verdicts.checked_lengths`), in words."""
    low, high = (f"{row[key]:.4g}" for key in ("shortest_mm", "longest_mm"))
    size = f"{low} mm" if low == high else f"{low} to {high} mm"
    untested = f"Lengths over {high} mm are untested."
    if row["rms_mm"] is None:
        return f"Lengths tested: none, because the only reference length ({size}) fixed the scale. {untested}"
    held = f"{row['held_out']} of them" if row["held_out"] else "none"
    predicted = "" if row["predicted_mm"] is None else f", predicted {two_digits(row['predicted_mm'])} mm"
    return (
        f"Lengths tested: {row['lengths']} ({size}), {held} held out; RMS error "
        f"{two_digits(row['rms_mm'])} mm{predicted}. {untested}"
    )


def held_out_sentence(row: Mapping[str, Any]) -> str:
    """What poses that a calibration left out say of it (`observations.distances_row`), in words."""
    if row["rms_mm"] is None:
        return f"Held out: {pluralise(row['poses'], 'pose')}."
    before, predicted = (
        "" if row[key] is None else f"{row[key]:.3g} mm" for key in ("rms_nominal_mm", "rms_predicted_mm")
    )
    found = f"{before} nominal, {row['rms_mm']:.3g} mm calibrated" if before else f"{row['rms_mm']:.3g} mm"
    return (
        f"Held out: {pluralise(row['poses'], 'pose')}; RMS distance from their geometry, as the other poses determine "
        f"it, {found}{predicted and f' (predicted {predicted})'}, largest {row['largest_mm']:.3g} mm."
    )


def cross_validated_sentence(row: Mapping[str, Any]) -> str:
    """What a cross-validation says of a calibration (`calibration.cross_validation_summary`), in words."""
    before, after, predicted = (row[key] for key in ("rms_nominal_mm", "rms_mm", "rms_predicted_mm"))
    found = f"{after:#.3g} mm calibrated" if before is None else f"{before:#.3g} mm nominal, {after:#.3g} mm calibrated"
    return (
        f"Cross-validation: each of {row['groups']} groups held out once; RMS distance of poses from their geometry, "
        f"fitted to them again, {found} (predicted {predicted:#.3g} mm)."
    )


def shared_sentence(rows: Sequence[Mapping[str, Any]]) -> str:
    """Shared errors in words."""
    words = {PLACES: "all poses of a socket", VISITS: "all poses of a visit"}

    def shown(row: Mapping[str, Any]) -> str:
        scale, unit = (1.0, "mm") if row["unit"] == "mm" else people_read_change(row["unit"])
        sd = float(f"{row['sd'] * scale:.3g}")
        return f"{words.get(row['kind'], row['kind'])} {sd:g} {unit}"

    functions = [shown(row) for row in rows if row["kind"] not in (PLACES, VISITS, SUCCESSIVE)]
    parts = [shown(row) for row in rows if row["kind"] in (PLACES, VISITS, SUCCESSIVE)]
    parts += [f"functions missing from the model: {', '.join(functions)}"] if functions else []
    return f"Shared errors of several poses, included in the uncertainty (standard deviations): {'; '.join(parts)}."


def tried_sentence(row: Mapping[str, Any]) -> str:
    """How much of the volume a calibration has tried, in words."""
    return (
        f"{100 * row['tried'] / row['poses']:.2g} % of the joint space is covered by calibration poses: in this part, "
        "the nearest calibration pose is no farther away than the spacing of the calibration poses "
        f"({row['spacing_rad'] / DEG:.2g} deg RMS over the joints). In the rest of the joint space, U is an "
        "extrapolation by the model."
    )
