"""The second page of a printed certificate: the results."""

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any
from xml.etree.ElementTree import Element

from .conformity import BASED_ON, STAGES, lacking_of, limit_of, says_of, stage_before, tests_of
from .languages import Language
from .sections import (
    MOST_ROWS,
    Section,
    content,
    expanded_of,
    first,
    in_degrees,
    more,
    named_in,
    number_of,
    shortened,
    value_of,
    without_u,
)
from .xml_elements import LEFT_OUT_NAMES, PREFIXES

_MOST_FINDINGS, _MOST_JOINTS = 4, 8  # the certificate has two pages
_MOST_CHARACTERS = 280  # of a finding
_COLUMNS = ("alpha", "a", "d", "theta", "beta")
# Of verdicts, the worst first.
_VERDICTS = ("fail", "conditionalFail", "conditionalPass", "pass")


def results_page(results: dict[str, Element], statements: dict, words: Language) -> Iterator[Section]:
    """The parts of the page, of measurement results and statements by their names."""
    before = stage_before(results)
    stages = [named_in(results[f"{stage[0].upper()}{stage[1:]}"], "dcc:results/dcc:result")
              for stage in (STAGES[before], STAGES["after"])]  # fmt: skip
    for section in (_repeatability, _lengths, _observations):
        yield from section(stages, before, words)
    yield from _held_out(stages[1], words)
    yield from _volume(stages[1], words)
    yield from _parameters(stages[1], words("parameters"), words)
    yield from _parameters(stages[0], words("parameters_before", before=words(before)), words)
    tests = [tests_of(results, stage) for stage in (before, "after")]
    tested = results.get(f"Acceptance tests, {STAGES['after']}")
    u_test = _u_test(tested, words)
    unused = content(tested, "dcc:description").endswith("not used for the calibration.")
    called = dict.fromkeys(name.partition(": ")[0] for name in tests[1])
    for standard in called:
        yield _tests(standard, tests[0], tests[1], before, u_test, words, unused=unused)
        u_test = ""  # said once
    yield from _findings(statements, words)


def _findings(statements: dict, words: Language) -> Iterator[Section]:
    left_out, warnings = (
        [content(x, "dcc:declaration") for x in statements.get(name, ())] for name in ("Data left out", "Warning")
    )
    found = [*left_out, *warnings]
    if words.code == "en":
        notes = [_beginning(sentences) for sentences in found[:_MOST_FINDINGS]]
        notes += more(len(found) - _MOST_FINDINGS, words)
    else:
        names = (name for says in left_out for name in says.rpartition(LEFT_OUT_NAMES)[2].removesuffix(".").split(", "))
        reasons = "; ".join(filter(None, dict.fromkeys(map(words.reason, left_out))))
        stated = " – ".join(filter(None, (_by_socket(names, words), reasons)))
        notes = [words("left_out_sentence", names=stated)] if left_out else []
        notes += [words.counted("warnings_sentence", str(len(warnings)))] if warnings else []
    if notes:
        yield Section(words("findings"), notes=notes)


def _by_socket(names: Iterable[str], words: Language) -> str:
    """Names of what was left out, with the numbers of poses behind their socket: "T2, C (poses 1, 2)"."""
    poses: dict[str, list[str]] = {}
    for name in names:
        of_pose = re.fullmatch(r"(.*) pose (\d+)", name, flags=re.DOTALL)
        socket, number = of_pose.groups() if of_pose else (name, "")
        poses.setdefault(socket, []).extend(filter(None, [number]))
    texts = [f"{socket} ({words('poses')} {', '.join(x)})" if x else socket for socket, x in poses.items()]
    return ", ".join([*texts[:MOST_ROWS], *([f"+ {len(texts) - MOST_ROWS}"] if len(texts) > MOST_ROWS else [])])


def _beginning(text: str) -> str:
    """A text, as many whole sentences of it as there is space for, or the beginning of the first."""
    if len(text) <= _MOST_CHARACTERS:
        return text
    beginning = text[:_MOST_CHARACTERS]
    whole = beginning.rpartition(". ")[0]
    return f"{whole}." if whole else beginning.rpartition(" ")[0] + " ..."


def _repeatability(stages: list[dict[str, Element]], before: str, words: Language) -> Iterator[Section]:
    rows = [named_in(stage.get("Repeatability"), "dcc:data/dcc:quantity") for stage in stages]
    if rows[1]:
        yield Section(
            words("repeatability"),
            headings=[words("quantity"), words(before), words("after")],
            table=[[words(name), *(without_u(stage.get(name), words) for stage in rows)] for name in rows[1]],
        )


def _lengths(stages: list[dict[str, Element]], before: str, words: Language) -> Iterator[Section]:
    lists = [named_in(stage.get("Reference lengths"), "dcc:data/dcc:list") for stage in stages]
    rows, by_construction = [], False
    for name, length in lists[1].items():
        quantities = named_in(length, "dcc:quantity")
        error, earlier = quantities.get("error"), named_in(lists[0].get(name), "dcc:quantity").get("error")
        by_construction |= error is None
        expanded, factor = ("", "") if error is None else expanded_of(error)
        cells = (number_of(quantities["calibrated value"], words), number_of(earlier, words), number_of(error, words))
        size = -math.inf if error is None else abs(float(value_of(error)))
        rows.append((size, [name, *cells, words.number(expanded), words.number(factor)]))
    before_and_after = words("error_before", before=words(before)), words("error")
    headings = words("length"), words("certified_value"), *before_and_after, "U", "k"
    notes = [words("by_construction_sentence")] if by_construction else []
    if "Scale" in stages[1]:
        k = first(stages[1]["Scale"], "dcc:data/dcc:quantity")
        expanded, factor = expanded_of(k)
        says = value_of(k) + (f" ± {expanded} (k = {factor})".replace(" ", "\u00a0") if expanded else "")
        notes.append(words("scale_sentence", k=words.number(says)))
    yield from _largest(words("lengths"), headings, rows, words, notes=notes)


def _observations(stages: list[dict[str, Element]], before: str, words: Language) -> Iterator[Section]:
    lists = [named_in(stage.get("Observations"), "dcc:data/dcc:list") for stage in stages]
    rows = []
    for name, part in lists[1].items():
        both = [named_in(x, "dcc:quantity").get("RMS residual") for x in (lists[0].get(name), part)]
        size = 0.0 if both[1] is None else float(value_of(both[1]))
        kind, *_, poses = re.split("[,;] ", content(part, "dcc:description"))
        counted = poses.removesuffix(" poses")
        rows.append((size, [name, words.known(f"kind_{kind}", kind), counted, *(without_u(x, words) for x in both)]))
    headings = words("observation"), words("kind"), words("poses"), words(before), words("after")
    yield from _largest(words("observations"), headings, rows, words, texts=2)


def _largest(
    title: str,
    headings: Sequence[str],
    rows: Sequence[tuple[float, list[str]]],
    words: Language,
    texts: int = 1,
    notes: Sequence[str] = (),
) -> Iterator[Section]:
    """A table of rows with their sizes: of many, the largest in their order."""
    if rows:
        least = sorted((size for size, _ in rows), reverse=True)[:MOST_ROWS][-1]
        kept = [row for size, row in rows if size >= least][:MOST_ROWS]
        fewer = words("fewer_sentence", shown=str(len(kept)), all=str(len(rows)))
        notes = [*notes, *([fewer] if len(kept) < len(rows) else [])]
        yield Section(title, headings=headings, table=kept, texts=texts, notes=notes)


def _held_out(stage: dict[str, Element], words: Language) -> Iterator[Section]:
    quantities = named_in(stage.get("Held-out poses"), "dcc:data/dcc:quantity")
    if quantities:
        shown = (f"{words(name)}: {without_u(x, words)}" for name, x in quantities.items() if name != "poses")
        poses = f"{number_of(quantities['poses'], words)} {words('poses')}"
        yield Section(words("held_out"), paragraphs=["; ".join([poses, *shown])])


def _volume(stage: dict[str, Element], words: Language) -> Iterator[Section]:
    rows, statistics = [], ("median", "95th percentile", "largest")
    result = stage.get("Expanded uncertainty")
    for name, part in named_in(result, "dcc:data/dcc:list").items():
        quantities = named_in(part, "dcc:quantity")
        says = words(name, length=number_of(quantities.get("length"), words).removesuffix(words.number(".0")))
        rows.append([says, *(number_of(quantities[key], words) for key in statistics)])
    notes = [
        words("covered_sentence", percent=f"{100 * float(value_of(share)):.0f}")
        for share in named_in(result, "dcc:data/dcc:quantity").values()
    ]
    if rows:
        yield Section(words("volume"), headings=[words("quantity"), *map(words, statistics)], table=rows, notes=notes)


def _parameters(stage: dict[str, Element], title: str, words: Language) -> Iterator[Section]:
    quantities = named_in(stage.get("Denavit-Hartenberg parameters"), "dcc:data/dcc:quantity")
    joints = sum(bool(re.fullmatch(r"alpha_\d+", name)) for name in quantities)
    numbers = [str(i) for i in range(1, joints + 1)]
    shown, factors = {}, set()
    for name in (f"{key}_{i}" for key in (*_COLUMNS, "probe") for i in (*numbers, *"xyz")):
        if joints <= _MOST_JOINTS and name in quantities:
            (value, expanded), factor = in_degrees(quantities[name]), expanded_of(quantities[name])[1]
            shown[name] = words.number(f"{value} ± {expanded}" if expanded else value)
            factors |= {float(factor)} if factor else set()
    zero = all(shown.get(f"beta_{i}", "") in ("", words.number("0.0")) for i in numbers)
    columns = _COLUMNS[:-1] if zero else _COLUMNS
    rows = [[i, *(shown.get(f"{key}_{i}", "") for key in columns)] for i in numbers]
    if shown:
        tip = [f"{axis}: {shown.get(f'probe_{axis}', '')}" for axis in "xyz"]
        rows.append([words("probe"), *tip, *[""] * (len(columns) - 3)])
    described = content(stage.get("Denavit-Hartenberg parameters"), "dcc:description")
    convention = re.search(r"Standard convention; the transform of a joint is ([^.]*)\.", described)
    notes = []
    if convention and factors:  # said once
        stated = dict.fromkeys(f"{factor:g}" for factor in (min(factors), max(factors)))
        sentences = [
            words("convention_sentence", transform=convention[1].removesuffix(" Ry(beta)" if zero else "")),
            words("parameters_sentence", factors=words.number(" – ".join(stated))),
            *more(len(quantities) - len(shown), words),
        ]
        notes = [" ".join(sentences)]
    yield Section(title, headings=[words("joint"), *columns], table=rows if shown else [], notes=notes)


def _tests(
    standard: str,
    earlier: dict[str, Element],
    tests: dict[str, Element],
    before: str,
    u_test: str,
    words: Language,
    *,
    unused: bool,
) -> Section:
    """The worst value of each metric of the tests by a standard, whose names are "standard: title"."""
    edition = standard.removeprefix(BASED_ON)
    incomplete = edition != standard
    rows, factors = [], {}
    for name, test in tests.items():
        first = named_in(earlier.get(name), "dcc:data/dcc:list")
        metrics = named_in(test, "dcc:data/dcc:list") if name.partition(": ")[0] == standard else {}
        for symbol, metric in metrics.items():
            worst = _worst(metric.findall("dcc:quantity", PREFIXES))
            was = _worst(first[symbol].findall("dcc:quantity", PREFIXES)) if symbol in first else None
            expanded, factor = expanded_of(worst)
            factors |= {factor: None} if factor else {}
            limit, verdict = limit_of(worst)
            numbers = [
                number_of(was, words),
                number_of(worst, words),
                words.number(expanded),
                words.number(shortened(limit)),
            ]
            rows.append([symbol, says_of(symbol, words), *numbers, words(verdict) if verdict else "–"])
    factor = words.number(next(iter(factors), "2"))
    sentences = [words("tests_sentence", factor=factor, u=u_test)] if u_test else []
    if incomplete:
        sentences += [words("incomplete_sentence", standard=edition), lacking_of(standard, tests, words)]
    return Section(
        words(
            "tests_unused" if unused else "tests_used",
            standard=words("based_on", standard=edition) if incomplete else edition,
        ),
        headings=[words("quantity"), "", words(before), words("after"), "U", words("limit"), words("decision")],
        table=rows,
        texts=2,
        notes=[" ".join(sentences)],
    )


def _u_test(tests: Element | None, words: Language) -> str:
    """The standard uncertainty that seat and fixture add to values of a test: "0.002 mm", "0.002 mm, 1e-06 L"."""
    condition = "dcc:influenceConditions/dcc:influenceCondition/dcc:data/dcc:quantity"
    numbers = (number_of(x, words) for x in named_in(tests, condition).values())
    return ", ".join(f"{x} {unit}" for x, unit in zip(numbers, ("mm", "L"), strict=False)).replace(" ", "\u00a0")


def _worst(quantities: Iterable[Element]) -> Element:
    """The value with the worst verdict and, of several, farthest beyond its limit; the largest without limits."""

    def badness(quantity: Element) -> tuple[Any, ...]:
        limit, verdict = limit_of(quantity)
        size = abs(float(value_of(quantity)))
        return (-_VERDICTS.index(verdict), size - float(limit)) if verdict in _VERDICTS and limit else (-9, size)

    return max(quantities, key=badness)
