"""The statement of conformity of a printed certificate, on its first page: verdict, specification, rule, limits and
procedure."""

import re
from collections.abc import Iterable, Mapping
from xml.etree.ElementTree import Element

from ..acceptance.judgement import RULES
from .languages import Language
from .sections import VALUE, Section, content, named_in, shortened
from .xml_elements import PREFIXES

BASED_ON = "based on "  # before the name of a standard whose procedure was not carried out in full
_MOST_MISSING = 130  # characters of what a procedure lacks: the certificate has two pages
STAGES = {"nominal": "nominal parameters", "as_found": "parameters as found", "after": "calibrated parameters"}


def stage_before(results: Mapping[str, Element]) -> str:
    """With which parameters the calibrated ones are compared: those as found, where they are known."""
    return "as_found" if "Parameters as found" in results else "nominal"


def conformity(results: Mapping[str, Element], statements: Mapping[str, list[Element]], words: Language) -> Section:
    """What is stated about conformity; without a statement, that there is none."""
    before = stage_before(results)
    earlier, after = (tests_of(results, stage) for stage in (before, "after"))
    norms = {norm.text for test in after.values() for norm in test.iterfind(".//dcc:metaData/dcc:norm", PREFIXES)}
    rule, facts = "; ".join(text for text in RULES.values() if text in norms), []
    for stated in statements.get("Conformity", ()):
        rule = content(stated, "dcc:declaration")
        facts = [
            (words("verdict"), _verdict(stated, earlier.values(), before, words)),
            (words("specification"), stated.findtext("dcc:norm", "", PREFIXES)),
        ]
    says = words("conformity_sentence" if facts else "no_conformity_sentence")
    for key, text in RULES.items():
        rule = rule.replace(text, words(key))
    if rule:
        facts += [
            (words("decision_rule"), rule),
            (words("limits"), _limits(after.values(), words)),
            (words("procedure"), _procedures(after, words)),
        ]
    return Section(words("conformity"), facts, [says])


def tests_of(results: Mapping[str, Element], stage: str) -> dict[str, Element]:
    """The acceptance tests with the parameters of a stage."""
    return named_in(results.get(f"Acceptance tests, {STAGES[stage]}"), "dcc:results/dcc:result")


def limit_of(quantity: Element) -> tuple[str, str]:
    """Limit and verdict of a value, "" where there is none."""
    stated = quantity.find("dcc:measurementMetaData/dcc:metaData", PREFIXES)
    if stated is None:
        return "", ""
    limit = stated.findtext(f"dcc:data/dcc:quantity/{VALUE}", "", PREFIXES)
    return limit, stated.findtext("dcc:conformity", "", PREFIXES)


def says_of(symbol: str, words: Language) -> str:
    """What a metric of an acceptance test is, in words."""
    return words("metric_" + re.split("[.:]", symbol)[0])


def lacking_of(standard: str, tests: Mapping[str, Element], words: Language) -> str:
    """What the procedure of the tests by a standard lacks; their names are "standard: title"."""
    of_standard = (test for name, test in tests.items() if name.partition(": ")[0] == standard)
    lacking = (content(test, "dcc:description").partition("not carried out. ")[2] for test in of_standard)
    says = words.translated(" ".join(dict.fromkeys(x.partition(" Expanded uncertainties")[0] for x in lacking)))
    return says if 0 < len(says) <= _MOST_MISSING else words("missing_sentence")


def _verdict(stated: Element, earlier: Iterable[Element], before: str, words: Language) -> str:
    """The verdict, that it is of the calibrated parameters, and whether the arm fails with those before."""
    verdict = words("verdict_sentence", verdict=words(stated.findtext("dcc:conformity", "", PREFIXES)))
    metrics = (part for test in earlier for part in named_in(test, "dcc:data/dcc:list").items())
    fails = dict.fromkeys(
        says_of(symbol, words)
        for symbol, metric in metrics
        if any(limit_of(x)[1] == "fail" for x in metric.iterfind("dcc:quantity", PREFIXES))
    )
    return "; ".join([verdict, *([words(f"fails_{before}_sentence", metrics=", ".join(fails))] if fails else [])])


def _limits(tests: Iterable[Element], words: Language) -> str:
    """The limits by which values were decided; from the least to the largest where they grow with a length."""
    limits = {}
    for test in tests:
        for symbol, metric in named_in(test, "dcc:data/dcc:list").items():
            numbers = {limit for x in metric.iterfind("dcc:quantity", PREFIXES) if (limit := limit_of(x)[0])}
            limits.setdefault(symbol, set()).update(numbers)
    ends = {key: dict.fromkeys(shortened(f(x, key=float)) for f in (min, max)) for key, x in limits.items() if x}
    numbers = {symbol: f"{words.number(' – '.join(both))} mm".replace(" ", "\u00a0") for symbol, both in ends.items()}
    return "; ".join(f"{symbol}, {says_of(symbol, words)}: {limit}" for symbol, limit in numbers.items())


def _procedures(tests: Mapping[str, Element], words: Language) -> str:
    """By which standards values were decided, and what their procedures lack."""
    stated = {}
    for name, test in tests.items():
        if any(limit_of(x)[0] for x in test.iterfind("dcc:data/dcc:list/dcc:quantity", PREFIXES)):
            standard = name.partition(": ")[0]
            edition = standard.removeprefix(BASED_ON)
            in_part = f"{words('in_part', standard=edition)}: {lacking_of(standard, tests, words).removesuffix('.')}"
            stated[standard] = edition if edition == standard else in_part
    return "; ".join(stated.values())
