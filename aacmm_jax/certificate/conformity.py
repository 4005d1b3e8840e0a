"""The statement of conformity of a printed certificate, on its first page: verdict, specification, rule and limits."""

from collections.abc import Iterable, Mapping
from xml.etree.ElementTree import Element

from ..acceptance.judgement import RULES
from .languages import Language
from .sections import VALUE, Section, content, named_in, shortened
from .xml_elements import PREFIXES

STAGES = {"nominal": "nominal parameters", "as_found": "parameters as found", "after": "calibrated parameters"}


def stage_before(results: Mapping[str, Element]) -> str:
    """With which parameters the calibrated ones are compared: those as found, where they are known."""
    return "as_found" if "Parameters as found" in results else "nominal"


def conformity(results: Mapping[str, Element], statements: Mapping[str, list[Element]], words: Language) -> Section:
    """What is stated about conformity; without a statement, that there is none."""
    before = stage_before(results)
    earlier, after = (tests_of(results, stage).values() for stage in (before, "after"))
    norms = {norm.text for test in after for norm in test.iterfind(".//dcc:metaData/dcc:norm", PREFIXES)}
    rule, facts = "; ".join(text for text in RULES.values() if text in norms), []
    for stated in statements.get("Conformity", ()):
        rule = content(stated, "dcc:declaration")
        facts = [
            (words("verdict"), _verdict(stated, earlier, before, words)),
            (words("specification"), stated.findtext("dcc:norm", "", PREFIXES)),
        ]
    says = words("conformity_sentence" if facts else "no_conformity_sentence")
    for key, text in RULES.items():
        rule = rule.replace(text, words(key))
    if rule:
        facts += [(words("decision_rule"), rule), (words("limits"), _limits(after, words))]
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


def _verdict(stated: Element, earlier: Iterable[Element], before: str, words: Language) -> str:
    """The verdict, that it is of the calibrated parameters, and whether the arm fails with those before."""
    verdict = words("verdict_sentence", verdict=words(stated.findtext("dcc:conformity", "", PREFIXES)))
    metrics = (part for test in earlier for part in named_in(test, "dcc:data/dcc:list").items())
    fails = [symbol for symbol, metric in metrics
             if any(limit_of(x)[1] == "fail" for x in metric.iterfind("dcc:quantity", PREFIXES))]  # fmt: skip
    return "; ".join([verdict, *([words(f"fails_{before}_sentence", metrics=", ".join(fails))] if fails else [])])


def _limits(tests: Iterable[Element], words: Language) -> str:
    """The limits by which values were decided; from the least to the largest where they grow with a length."""
    limits = {}
    for test in tests:
        for symbol, metric in named_in(test, "dcc:data/dcc:list").items():
            numbers = {limit for x in metric.iterfind("dcc:quantity", PREFIXES) if (limit := limit_of(x)[0])}
            limits.setdefault(symbol, set()).update(numbers)
    ends = {key: dict.fromkeys(shortened(f(x, key=float)) for f in (min, max)) for key, x in limits.items() if x}
    stated = (f"{symbol} {words.number(' – '.join(both))} mm" for symbol, both in ends.items())
    return "; ".join(text.replace(" ", "\u00a0") for text in stated)
