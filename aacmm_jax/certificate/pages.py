"""What the two pages of a printed certificate say, made of a Digital Calibration Certificate (DCC) and nothing else.

What is printed is a choice of what the DCC says, to the digit. Its words are those of a language file; sentences that
the DCC has in English only are printed in English alone, and other languages refer to them.
"""

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element

from ..acceptance.judgement import RULES
from ..core.errors import InputError
from ..files.administrative_data import NOT_STATED
from .languages import Language
from .xml_elements import CELSIUS, MILLIMETRE, ONE, PREFIXES, RADIAN, root_of

_UNITS = {MILLIMETRE: "mm", RADIAN: "rad", CELSIUS: "°C", ONE: ""}
_MOST_ROWS, _MOST_FINDINGS, _MOST_JOINTS = 6, 4, 8  # of a table: the certificate has two pages
_COLUMNS = ("alpha", "a", "d", "theta", "beta")
_MOST_CHARACTERS = 280  # of a finding
_VALUE, _UNCERTAINTY = "si:real/si:value", "si:real/si:measurementUncertaintyUnivariate/"
_STAGES = {"nominal": "nominal parameters", "as_found": "parameters as found", "after": "calibrated parameters"}
# Of verdicts, the worst first.
_VERDICTS = ("fail", "conditionalFail", "conditionalPass", "pass")


class Section(NamedTuple):
    """A part of a page: a title, and below it what is not empty, in this order."""

    title: str
    facts: Sequence[tuple[str, str]] = ()  # labels and values
    paragraphs: Sequence[str] = ()
    headings: Sequence[str] = ()  # of the table
    table: Sequence[Sequence[str]] = ()
    texts: int = 1  # columns of the table, from the first, that are texts; the others are numbers
    notes: Sequence[str] = ()
    signatures: Sequence[tuple[str, str]] = ()  # names and roles


class Pages(NamedTuple):
    """What both pages say."""

    language: str
    laboratory: Sequence[str]  # its name, then its address
    title: str
    number: str
    banner: str
    pages: tuple[list[Section], list[Section]]
    results: str  # title of the second page
    page: str  # "Page {page} of {pages}"
    download: str  # what the link to the DCC says
    created: str  # date, ISO 8601


def pages_of(dcc: str, words: Language) -> Pages:
    """What both pages say. Raises `InputError` if the text is no DCC of this package."""
    root = root_of(dcc)
    administrative = _first(root, "dcc:administrativeData")
    core = _first(administrative, "dcc:coreData")
    laboratory = _first(administrative, "dcc:calibrationLaboratory")
    code = laboratory.findtext("dcc:calibrationLaboratoryCode", "", PREFIXES)
    statements = {}
    for statement in administrative.iterfind("dcc:statements/dcc:statement", PREFIXES):
        statements.setdefault(_content(statement, "dcc:name"), []).append(statement)
    results = {
        _content(result, "dcc:name"): result
        for result in root.iterfind("dcc:measurementResults/dcc:measurementResult", PREFIXES)
    }
    if "Calibrated parameters" not in results:
        raise InputError("the certificate has no results by calibrated parameters; give a DCC that aacmm wrote.")
    return Pages(
        language=words.code,
        laboratory=[
            *_address(_first(laboratory, "dcc:contact"), words),
            *([f"{words('accreditation')}: {code}"] if code else []),
        ],
        title=words("title"),
        number=core.findtext("dcc:uniqueIdentifier", "", PREFIXES),
        banner=words("simulated") if "Simulation" in statements else "",
        pages=(
            list(_first_page(administrative, core, results, statements, words)),
            list(_second_page(results, statements, words)),
        ),
        results=words("results"),
        page=words("page"),
        download=words("download"),
        created=core.findtext("dcc:issueDate", core.findtext("dcc:endPerformanceDate", "", PREFIXES), PREFIXES),
    )


def _first(parent: Element, path: str) -> Element:
    found = parent.find(path, PREFIXES)
    if found is None:
        raise InputError(f"the certificate has no {path.rpartition(':')[2]}; give a DCC that aacmm wrote.")
    return found


def _content(parent: Element | None, path: str) -> str:
    """The text of a ``dcc:name`` or the like, "" where there is none."""
    return "" if parent is None else parent.findtext(f"{path}/dcc:content", "", PREFIXES) or ""


def _address(contact: Element, words: Language) -> list[str]:
    place = _first(contact, "dcc:location")
    part = {key: place.findtext(f"dcc:{key}", "", PREFIXES) for key in ("street", "postCode", "city", "countryCode")}
    city = " ".join(filter(None, (part["postCode"], part["city"])))
    lines = [part["street"], city, part["countryCode"]]
    reached = (contact.findtext(f"dcc:{key}", "", PREFIXES) for key in ("eMail", "phone"))
    name = words.stated(_content(contact, "dcc:name"))
    return [name, *filter(None, (", ".join(filter(None, lines)), ", ".join(filter(None, reached))))]


def _identification(item: Element, name: str) -> str:
    for number in item.iterfind("dcc:identifications/dcc:identification", PREFIXES):
        if _content(number, "dcc:name") == name:
            return number.findtext("dcc:value", "", PREFIXES)
    return ""


def _first_page(
    administrative: Element, core: Element, results: dict[str, Element], statements: dict, words: Language
) -> Iterator[Section]:
    item, after = _first(administrative, "dcc:items/dcc:item"), results["Calibrated parameters"]
    days = [core.findtext(f"dcc:{key}PerformanceDate", "", PREFIXES) for key in ("begin", "end")]
    facts = {
        "object": _content(item, "dcc:name"),
        "manufacturer": words.stated(_content(item, "dcc:manufacturer/dcc:name")),
        "model": words.stated(item.findtext("dcc:model", "", PREFIXES)),
        "serial_number": words.stated(_identification(item, "Serial number")),
        "customer_number": _identification(item, "Customer's number"),
        "condition": _content(item, "dcc:description"),
        "customer": "; ".join(_address(_first(administrative, "dcc:customer"), words)),
        "replaces": core.findtext("dcc:reportAmendedSubstituted/dcc:replacedUniqueIdentifier", "", PREFIXES),
        "received": core.findtext("dcc:receiptDate", "", PREFIXES),
        "calibrated": " – ".join(dict.fromkeys(days)),
        "place": words("place_" + core.findtext("dcc:performanceLocation", "other", PREFIXES)),
        "issued": core.findtext("dcc:issueDate", "", PREFIXES),
    }
    yield Section(words("identification"), [(words(key), value) for key, value in facts.items() if value])
    described = _content(after.find("dcc:usedMethods/dcc:usedMethod", PREFIXES), "dcc:description")
    counts = [(name.lower(), number) for name, number in re.findall(r"(\w[\w ]*): (\d+)(?=[;.])", described)]
    counted = ", ".join(words.counted(name, number) for name, number in counts if number != "0")
    software = _first(after, "dcc:usedSoftware/dcc:software")
    name = f"{_content(software, 'dcc:name')} {software.findtext('dcc:release', '', PREFIXES)}"
    yield Section(
        words("method"),
        paragraphs=[words("method_sentence", counts=counted), words("software_sentence", software=name)],
    )
    condition = after.find("dcc:influenceConditions/dcc:influenceCondition/dcc:data/dcc:quantity", PREFIXES)
    celsius = words("not_stated") if condition is None else _with_u(condition, words)
    yield Section(words("conditions"), [(words("temperature"), celsius)])
    headings = "artefact", "manufacturer", "serial_number", "certificate_number", "certified"
    yield Section(
        words("traceability"),
        paragraphs=[words("traceability_sentence")],
        headings=[words(key) for key in headings],
        table=[_equipment(x, words) for x in after.iterfind("dcc:measuringEquipments/*", PREFIXES)][:_MOST_ROWS],
        texts=len(headings),
    )
    yield Section(words("uncertainty"), paragraphs=[words("uncertainty_sentence")])
    remarks = [_content(statement, "dcc:declaration") for statement in statements.get("Remarks", ())]
    general = [words(f"{key}_sentence") for key in ("item", "attached", "copies")]
    yield Section(words("remarks"), paragraphs=[*remarks, " ".join(general)])
    persons = [
        (
            _content(person, "dcc:person/dcc:name").replace(NOT_STATED, ""),
            person.findtext("dcc:role", "", PREFIXES),
            person.findtext("dcc:mainSigner", "", PREFIXES) != "true",
        )
        for person in administrative.iterfind("dcc:respPersons/dcc:respPerson", PREFIXES)
    ]
    signers = sorted(persons, key=lambda person: person[2])[:3]
    yield Section(
        words("signatures"),
        headings=[words("date"), words("signature")],
        signatures=[(name, role) for name, role, _ in signers],
    )


def _equipment(equipment: Element, words: Language) -> list[str]:
    name = _content(equipment, "dcc:name")
    quantities = equipment.findall("dcc:measuringEquipmentQuantities/*", PREFIXES)
    values = "; ".join(_with_u(quantity, words) for quantity in quantities[:3])
    maker = _content(equipment, "dcc:manufacturer/dcc:name"), equipment.findtext("dcc:model", "", PREFIXES)
    return [
        words.known(name, name),
        ", ".join(filter(None, maker)),
        _identification(equipment, "Serial number"),
        _identification(equipment, "Number of its calibration certificate"),
        "; ".join([values, *_more(len(quantities) - 3, words)]),
    ]


def _with_u(quantity: Element, words: Language) -> str:
    """A value with its unit and standard uncertainty, as they were given."""
    unit = quantity.findtext("si:real/si:unit", "", PREFIXES)
    unit = _UNITS.get(unit, unit)
    name = _content(quantity, "dcc:name")
    if name.startswith("standard uncertainty"):  # of what an instrument measured
        number, unit = f"{float(_value(quantity)):.2g}", "px" if name.endswith("in pixels") else unit
        return f"u = {words.number(number)} {unit}".replace(" ", "\u00a0")
    u = quantity.findtext(f"{_UNCERTAINTY}si:standardMU/si:valueStandardMU", "", PREFIXES)
    with_u = f" (u = {words.number(_short(u))} {unit})".replace(" )", ")") if u else ""
    return f"{words.number(_value(quantity))} {unit}{with_u}".strip().replace(" ", "\u00a0")


def _value(quantity: Element) -> str:
    return _short(quantity.findtext(_VALUE, "", PREFIXES))


def _short(text: str) -> str:
    """A number as the DCC has it, but of those that were given to 17 digits at most 7 decimals."""
    return text if len(text.partition(".")[2]) <= 8 and "e" not in text.lower() else f"{float(text):.7g}"


def _expanded(quantity: Element) -> tuple[str, str]:
    """Expanded uncertainty and coverage factor, "" where there is none."""
    parts = (f"{_UNCERTAINTY}si:expandedMU/si:{key}" for key in ("valueExpandedMU", "coverageFactor"))
    return tuple(quantity.findtext(path, "", PREFIXES) for path in parts)  # pyright: ignore[reportReturnType]


def _named(parent: Element | None, path: str) -> dict[str, Element]:
    """Elements of a path by their names."""
    return {} if parent is None else {_content(x, "dcc:name"): x for x in parent.iterfind(path, PREFIXES)}


def _second_page(results: dict[str, Element], statements: dict, words: Language) -> Iterator[Section]:
    before = "as_found" if "Parameters as found" in results else "nominal"
    stages = [_named(results[f"{stage[0].upper()}{stage[1:]}"], "dcc:results/dcc:result")
              for stage in (_STAGES[before], _STAGES["after"])]  # fmt: skip
    for section in (_repeatability, _lengths, _observations):
        yield from section(stages, before, words)
    yield from _held_out(stages[1], words)
    yield from _volume(stages[1], words)
    yield from _parameters(stages[1], words("parameters"), words)
    yield from _parameters(stages[0], words("parameters_before", before=words(before)), words)
    if "Scale" in stages[1]:
        k = _first(stages[1]["Scale"], "dcc:data/dcc:quantity")
        expanded, factor = _expanded(k)
        says = words.number(_value(k) + (f" ± {expanded} (k = {factor})".replace(" ", "\u00a0") if expanded else ""))
        yield Section(words("scale"), paragraphs=[words("scale_sentence", k=says)])
    tests = [_named(results.get(f"Acceptance tests, {_STAGES[stage]}"), "dcc:results/dcc:result")
             for stage in (before, "after")]  # fmt: skip
    called = dict.fromkeys(name.partition(": ")[0] for name in tests[1])
    for standard in called:
        yield _tests(standard, tests[0], tests[1], before, words)
    norms = {
        norm.text: None for test in tests[1].values() for norm in test.iterfind(".//dcc:metaData/dcc:norm", PREFIXES)
    }
    rules = [words(key) for key, text in RULES.items() if text in norms]
    facts = [(words("decision_rule"), "; ".join(rules))] if rules else []
    for stated in statements.get("Conformity", ()):
        facts = [
            (words("specification"), stated.findtext("dcc:norm", "", PREFIXES)),
            (words("decision_rule"), _content(stated, "dcc:declaration")),
            (words("verdict"), words(stated.findtext("dcc:conformity", "", PREFIXES))),
        ]
    yield Section(words("conformity"), facts, [] if facts else [words("no_conformity_sentence")])
    yield from _findings(statements, words)


def _findings(statements: dict, words: Language) -> Iterator[Section]:
    left_out, warnings = (
        [_content(x, "dcc:declaration") for x in statements.get(name, ())] for name in ("Data left out", "Warning")
    )
    found = [*left_out, *warnings]
    if words.code == "en":
        notes = [_beginning(sentences) for sentences in found[:_MOST_FINDINGS]]
        notes += _more(len(found) - _MOST_FINDINGS, words)
    else:
        notes = [words("left_out_sentence")] if left_out else []
        notes += [words.counted("warnings_sentence", str(len(warnings)))] if warnings else []
    if notes:
        yield Section(words("findings"), notes=notes)


def _beginning(text: str) -> str:
    """A text, as many whole sentences of it as there is space for, or the beginning of the first."""
    if len(text) <= _MOST_CHARACTERS:
        return text
    beginning = text[:_MOST_CHARACTERS]
    whole = beginning.rpartition(". ")[0]
    return f"{whole}." if whole else beginning.rpartition(" ")[0] + " ..."


def _more(count: int, words: Language) -> list[str]:
    return [words.counted("more_sentence", str(count))] if count > 0 else []


def _repeatability(stages: list[dict[str, Element]], before: str, words: Language) -> Iterator[Section]:
    rows = [_named(stage.get("Repeatability"), "dcc:data/dcc:quantity") for stage in stages]
    if rows[1]:
        yield Section(
            words("repeatability"),
            headings=[words("quantity"), words(before), words("after")],
            table=[[words(name), *(_number(stage.get(name), words) for stage in rows)] for name in rows[1]],
        )


def _number(quantity: Element | None, words: Language) -> str:
    return "" if quantity is None else words.number(_value(quantity))


def _lengths(stages: list[dict[str, Element]], before: str, words: Language) -> Iterator[Section]:
    lists = [_named(stage.get("Reference lengths"), "dcc:data/dcc:list") for stage in stages]
    rows, by_construction = [], False
    for name, length in lists[1].items():
        quantities = _named(length, "dcc:quantity")
        error, earlier = quantities.get("error"), _named(lists[0].get(name), "dcc:quantity").get("error")
        by_construction |= error is None
        expanded, factor = ("", "") if error is None else _expanded(error)
        cells = (_number(quantities["calibrated value"], words), _number(earlier, words), _number(error, words))
        size = -math.inf if error is None else abs(float(_value(error)))
        rows.append((size, [name, *cells, words.number(expanded), words.number(factor)]))
    before_and_after = words("error_before", before=words(before)), words("error")
    headings = words("length"), words("certified_value"), *before_and_after, "U", "k"
    note = [words("by_construction_sentence")] if by_construction else []
    yield from _largest(words("lengths"), headings, rows, words, notes=note)


def _observations(stages: list[dict[str, Element]], before: str, words: Language) -> Iterator[Section]:
    lists = [_named(stage.get("Observations"), "dcc:data/dcc:list") for stage in stages]
    rows = []
    for name, part in lists[1].items():
        both = [_named(x, "dcc:quantity").get("RMS residual") for x in (lists[0].get(name), part)]
        size = 0.0 if both[1] is None else float(_value(both[1]))
        kind, *_, poses = re.split("[,;] ", _content(part, "dcc:description"))
        counted = poses.removesuffix(" poses")
        rows.append((size, [name, words.known(f"kind_{kind}", kind), counted, *(_number(x, words) for x in both)]))
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
        least = sorted((size for size, _ in rows), reverse=True)[:_MOST_ROWS][-1]
        kept = [row for size, row in rows if size >= least][:_MOST_ROWS]
        fewer = words("fewer_sentence", shown=str(len(kept)), all=str(len(rows)))
        notes = [*notes, *([fewer] if len(kept) < len(rows) else [])]
        yield Section(title, headings=headings, table=kept, texts=texts, notes=notes)


def _held_out(stage: dict[str, Element], words: Language) -> Iterator[Section]:
    quantities = _named(stage.get("Held-out poses"), "dcc:data/dcc:quantity")
    if quantities:
        row = [[_number(quantity, words) for quantity in quantities.values()]]
        yield Section(words("held_out"), headings=[words(name) for name in quantities], table=row, texts=0)


def _volume(stage: dict[str, Element], words: Language) -> Iterator[Section]:
    rows, statistics = [], ("median", "95th percentile", "largest")
    for name, part in _named(stage.get("Expanded uncertainty"), "dcc:data/dcc:list").items():
        quantities = _named(part, "dcc:quantity")
        says = words(name, length=_number(quantities.get("length"), words).removesuffix(words.number(".0")))
        rows.append([says, *(_number(quantities[key], words) for key in statistics)])
    if rows:
        yield Section(words("volume"), headings=[words("quantity"), *map(words, statistics)], table=rows)


def _parameters(stage: dict[str, Element], title: str, words: Language) -> Iterator[Section]:
    quantities = _named(stage.get("Denavit-Hartenberg parameters"), "dcc:data/dcc:quantity")
    joints = sum(bool(re.fullmatch(r"alpha_\d+", name)) for name in quantities)
    numbers = [str(i) for i in range(1, joints + 1)]
    shown, factors = {}, set()
    for name in (f"{key}_{i}" for key in (*_COLUMNS, "probe") for i in (*numbers, *"xyz")):
        if joints <= _MOST_JOINTS and name in quantities:
            expanded, factor = _expanded(quantities[name])
            text = words.number(_value(quantities[name]))
            shown[name] = f"{text} ± {words.number(expanded)}" if expanded else text
            factors |= {float(factor)} if factor else set()
    zero = all(shown.get(f"beta_{i}", "") in ("", words.number("0.0")) for i in numbers)
    columns = _COLUMNS[:-1] if zero else _COLUMNS
    rows = [[i, *(shown.get(f"{key}_{i}", "") for key in columns)] for i in numbers]
    if shown:
        tip = [f"{axis}: {shown.get(f'probe_{axis}', '')}" for axis in "xyz"]
        rows.append([words("probe"), *tip, *[""] * (len(columns) - 3)])
    notes = []
    if factors:
        stated = dict.fromkeys(f"{factor:g}" for factor in (min(factors), max(factors)))
        notes.append(words("parameters_sentence", factors=words.number(" – ".join(stated))))
        notes += _more(len(quantities) - len(shown), words)
    yield Section(title, headings=[words("joint"), *columns], table=rows if shown else [], notes=notes)


def _tests(
    standard: str, earlier: dict[str, Element], tests: dict[str, Element], before: str, words: Language
) -> Section:
    """The worst value of each metric of the tests by a standard, whose names are "standard: title"."""
    edition = standard.removeprefix("based on ")
    incomplete = edition != standard
    rows, factors = [], {}
    for name, test in tests.items():
        first = _named(earlier.get(name), "dcc:data/dcc:list")
        metrics = _named(test, "dcc:data/dcc:list") if name.partition(": ")[0] == standard else {}
        for symbol, metric in metrics.items():
            worst = _worst(metric.findall("dcc:quantity", PREFIXES))
            was = _worst(first[symbol].findall("dcc:quantity", PREFIXES)) if symbol in first else None
            expanded, factor = _expanded(worst)
            factors |= {factor: None} if factor else {}
            limit, verdict = _limit(worst)
            numbers = [_number(was, words), _number(worst, words), words.number(expanded), words.number(_short(limit))]
            says = words("metric_" + re.split("[.:]", symbol)[0])
            rows.append([symbol, says, *numbers, words(verdict) if verdict else "–"])
    return Section(
        words("tests", standard=words("based_on", standard=edition) if incomplete else edition),
        headings=[words("quantity"), "", words(before), words("after"), "U", words("limit"), words("decision")],
        table=rows,
        texts=2,
        notes=[
            words("tests_sentence", factor=words.number(next(iter(factors), "2"))),
            *([words("incomplete_sentence", standard=edition)] if incomplete else []),
        ],
    )


def _limit(quantity: Element) -> tuple[str, str]:
    """Limit and verdict of a value, "" where there is none."""
    stated = quantity.find("dcc:measurementMetaData/dcc:metaData", PREFIXES)
    if stated is None:
        return "", ""
    limit = stated.findtext(f"dcc:data/dcc:quantity/{_VALUE}", "", PREFIXES)
    return limit, stated.findtext("dcc:conformity", "", PREFIXES)


def _worst(quantities: Iterable[Element]) -> Element:
    """The value with the worst verdict and, of several, farthest beyond its limit; the largest without limits."""

    def badness(quantity: Element) -> tuple[Any, ...]:
        limit, verdict = _limit(quantity)
        size = abs(float(_value(quantity)))
        return (-_VERDICTS.index(verdict), size - float(limit)) if verdict in _VERDICTS and limit else (-9, size)

    return max(quantities, key=badness)
