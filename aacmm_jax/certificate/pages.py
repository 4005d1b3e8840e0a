"""What the two pages of a printed certificate say, made of a Digital Calibration Certificate (DCC) and nothing else.

What is printed is a choice of what the DCC says: to the digit what has an uncertainty, the rest shorter. Its words are
those of a language file; sentences that the DCC has in English only are printed in English alone, and other languages
refer to them.
"""

import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple
from xml.etree.ElementTree import Element

from ..core.errors import InputError
from ..files.administrative_data import NOT_STATED
from .conformity import conformity
from .languages import Language
from .results_page import results_page
from .sections import MOST_ROWS, Section, content, first, identification, more, with_u
from .xml_elements import PREFIXES, root_of, states_number

_BANNERS = {"Simulation": "simulated", "Not usable": "not_usable"}
_RESERVATIONS = {"Not usable": "not_usable_sentence", "To be used with care": "with_care_sentence"}
_OF_LENGTH = re.compile(r"(?P<test>Test )?\d+: (?P<name>.*)", flags=re.DOTALL)  # the name of a length in the DCC


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
    administrative = first(root, "dcc:administrativeData")
    core = first(administrative, "dcc:coreData")
    laboratory = first(administrative, "dcc:calibrationLaboratory")
    number = core.findtext("dcc:uniqueIdentifier", "", PREFIXES)
    code = laboratory.findtext("dcc:calibrationLaboratoryCode", "", PREFIXES)
    statements = {}
    for statement in administrative.iterfind("dcc:statements/dcc:statement", PREFIXES):
        statements.setdefault(content(statement, "dcc:name"), []).append(statement)
    results = {
        content(result, "dcc:name"): result
        for result in root.iterfind("dcc:measurementResults/dcc:measurementResult", PREFIXES)
    }
    if "Calibrated parameters" not in results:
        raise InputError("the certificate has no results by calibrated parameters; give a DCC that aacmm wrote.")
    return Pages(
        language=words.code,
        laboratory=[
            *_address(first(laboratory, "dcc:contact"), words),
            *([f"{words('accreditation')}: {code}"] if code else []),
        ],
        title=words("title"),
        number=number if states_number(dcc, number) else words("number_not_stated"),
        banner=" ".join(words(key) for name, key in _BANNERS.items() if name in statements),
        pages=(
            list(_first_page(administrative, core, results, statements, words)),
            list(results_page(results, statements, words)),
        ),
        results=words("results"),
        page=words("page"),
        download=words("download"),
        created=core.findtext("dcc:issueDate", core.findtext("dcc:endPerformanceDate", "", PREFIXES), PREFIXES),
    )


def _address(contact: Element, words: Language) -> list[str]:
    place = first(contact, "dcc:location")
    part = {key: place.findtext(f"dcc:{key}", "", PREFIXES) for key in ("street", "postCode", "city", "countryCode")}
    city = " ".join(filter(None, (part["postCode"], part["city"])))
    lines = [part["street"], city, part["countryCode"] if city else ""]  # a code alone is not an address
    reached = (contact.findtext(f"dcc:{key}", "", PREFIXES) for key in ("eMail", "phone"))
    name = words.stated(content(contact, "dcc:name"))
    return [name, *filter(None, (", ".join(filter(None, lines)), ", ".join(filter(None, reached))))]


def _first_page(
    administrative: Element, core: Element, results: dict[str, Element], statements: dict, words: Language
) -> Iterator[Section]:
    item, after = first(administrative, "dcc:items/dcc:item"), results["Calibrated parameters"]
    days = [words.date(core.findtext(f"dcc:{key}PerformanceDate", "", PREFIXES)) for key in ("begin", "end")]
    facts = {
        "object": content(item, "dcc:name"),
        "manufacturer": words.stated(content(item, "dcc:manufacturer/dcc:name")),
        "model": words.stated(item.findtext("dcc:model", "", PREFIXES)),
        "serial_number": words.stated(identification(item, "Serial number")),
        "customer_number": identification(item, "Customer's number"),
        "condition": content(item, "dcc:description"),
        "customer": "; ".join(_address(first(administrative, "dcc:customer"), words)),
        "replaces": core.findtext("dcc:reportAmendedSubstituted/dcc:replacedUniqueIdentifier", "", PREFIXES),
        "received": words.date(core.findtext("dcc:receiptDate", "", PREFIXES)),
        "calibrated": " – ".join(dict.fromkeys(days)),
        "place": words("place_" + core.findtext("dcc:performanceLocation", "other", PREFIXES)),
        "issued": words.date(core.findtext("dcc:issueDate", "", PREFIXES)),
    }
    yield Section(words("identification"), [(words(key), value) for key, value in facts.items() if value])
    yield conformity(results, statements, words)
    described = content(after.find("dcc:usedMethods/dcc:usedMethod", PREFIXES), "dcc:description")
    counts = [(name.lower(), number) for name, number in re.findall(r"(\w[\w ]*): (\d+)(?=[;.])", described)]
    counted = ", ".join(words.counted(name, number) for name, number in counts if number != "0")
    software = first(after, "dcc:usedSoftware/dcc:software")
    name = f"{content(software, 'dcc:name')} {software.findtext('dcc:release', '', PREFIXES)}"
    yield Section(
        words("method"),
        paragraphs=[words("method_sentence", counts=counted), words("software_sentence", software=name)],
    )
    condition = after.find("dcc:influenceConditions/dcc:influenceCondition/dcc:data/dcc:quantity", PREFIXES)
    celsius = words("not_stated") if condition is None else with_u(condition, words)
    yield Section(words("conditions"), [(words("temperature"), celsius)])
    equipment = after.findall("dcc:measuringEquipments/*", PREFIXES)
    of_test = [*filter(_only_of_test, equipment)]
    rest = [x for x in equipment if x not in of_test]
    yield _traceability(words("traceability"), rest, words, [words("traceability_sentence")])
    if of_test:
        yield _traceability(words("test_equipment"), of_test, words)
    reservations = [
        content(statement, "dcc:declaration") if words.code == "en" else words(key)
        for name, key in _RESERVATIONS.items()
        for statement in statements.get(name, ())
    ]
    yield Section(words("uncertainty"), paragraphs=[words("uncertainty_sentence"), *reservations])
    remarks = [content(statement, "dcc:declaration") for statement in statements.get("Remarks", ())]
    general = [words(f"{key}_sentence") for key in ("item", "attached", "copies")]
    yield Section(words("remarks"), paragraphs=[*remarks, " ".join(general)])
    persons = [
        (
            content(person, "dcc:person/dcc:name").replace(NOT_STATED, ""),
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


def _traceability(title: str, equipment: list[Element], words: Language, paragraphs: Sequence[str] = ()) -> Section:
    headings = "artefact", "manufacturer", "serial_number", "certificate_number", "certified"
    table = [_equipment(x, words) for x in equipment]
    stated = [i for i in range(len(headings)) if i in (0, len(headings) - 1) or any(row[i] for row in table)]
    return Section(
        title,
        paragraphs=paragraphs,
        headings=[words(headings[i]) for i in stated],
        table=[[row[i] or "–" for i in stated] for row in table[:MOST_ROWS]],
        texts=len(stated),
        notes=more(len(table) - MOST_ROWS, words),
    )


def _only_of_test(equipment: Element) -> bool:
    """Whether an artefact has lengths, and these are of the test alone."""
    names = [content(x, "dcc:name") for x in equipment.iterfind("dcc:measuringEquipmentQuantities/*", PREFIXES)]
    return bool(names) and all((length := _OF_LENGTH.fullmatch(x)) and length["test"] for x in names)


def _equipment(equipment: Element, words: Language) -> list[str]:
    name = content(equipment, "dcc:name")
    quantities = equipment.findall("dcc:measuringEquipmentQuantities/*", PREFIXES)
    mixed = not _only_of_test(equipment)
    values: dict[str, list[str]] = {}  # names of lengths by what is certified of them
    for quantity in quantities:
        length = _OF_LENGTH.fullmatch(content(quantity, "dcc:name"))
        value = with_u(quantity, words)
        value = f"{words('test')}: {value}" if mixed and length and length["test"] else value
        values.setdefault(value, []).append(length["name"] if length else "")
    texts = [f"{names[0]}:\u00a0{value}" if len(names) == 1 and names[0] else value for value, names in values.items()]
    maker = content(equipment, "dcc:manufacturer/dcc:name"), equipment.findtext("dcc:model", "", PREFIXES)
    return [
        words.known(name, name),
        ", ".join(filter(None, maker)),
        identification(equipment, "Serial number"),
        identification(equipment, "Number of its calibration certificate"),
        "; ".join([*texts[:3], *more(len(texts) - 3, words)]),
    ]
