"""The content model of a Digital Calibration Certificate as this package uses it: version 3.3.0, with D-SI 2.

Written by hand from the published schemas (https://ptb.de/dcc/v3.3.0/dcc.xsd, https://ptb.de/si/v2.2.1/SI_Format.xsd),
so that certificates are checked without a network; `-m network` compares them with the schemas themselves. Only what
certificates of this package contain is in it: an element that is not, or is elsewhere, is an error.
"""

import re
from xml.etree import ElementTree

DCC, SI = "{https://ptb.de/dcc}", "{https://ptb.de/si}"
XSI = "{http://www.w3.org/2001/XMLSchema-instance}"

# By type: its children in their order, as a regular expression over their names, each followed by a blank.
CHILDREN = {
    "digitalCalibrationCertificate": "administrativeData measurementResults ",
    "administrativeData": "dccSoftware coreData items calibrationLaboratory respPersons customer (statements )?",
    "softwareList": "(software )+",
    "software": "name release (type )?(description )?",
    "coreData": "countryCodeISO3166_1 (usedLangCodeISO639_1 )+(mandatoryLangCodeISO639_1 )+uniqueIdentifier "
    "(identifications )?(receiptDate )?beginPerformanceDate endPerformanceDate performanceLocation (issueDate )?"
    "(reportAmendedSubstituted )?",
    "reportAmendedSubstituted": "typeOfChange replacedUniqueIdentifier ",
    "items": "(item )+",
    "item": "name (description )?(manufacturer )?(model )?identifications ",
    "identifications": "(identification )+",
    "identification": "issuer value (name )?",
    "calibrationLaboratory": "(calibrationLaboratoryCode )?contact ",
    "contact": "name (eMail )?(phone )?location ",
    "contactNotStrict": "name (eMail )?(phone )?(location )?",
    "location": "((city|countryCode|postCode|street|further) )+",
    "respPersons": "(respPerson )+",
    "respPerson": "person (role )?(mainSigner )?",
    "statements": "(statement )+",
    "statement": "(name )?(norm )*(declaration )?(conformity )?(data )?",
    "measurementResults": "(measurementResult )+",
    "measurementResult": "name (description )?(usedMethods )?(usedSoftware )?(measuringEquipments )?"
    "(influenceConditions )?results ",
    "usedMethods": "(usedMethod )+",
    "usedMethod": "name (description )?(norm )*",
    "measuringEquipments": "(measuringEquipment )+",
    "measuringEquipment": "name (description )?(manufacturer )?(model )?(identifications )?"
    "(measuringEquipmentQuantities )?",
    "measuringEquipmentQuantities": "(measuringEquipmentQuantity )+",
    "primitiveQuantity": "(name )?(description )?si:real ",
    "influenceConditions": "(influenceCondition )+",
    "influenceCondition": "name (description )?(status )?data ",
    "results": "(result )+",
    "result": "name (description )?data ",
    "data": "((text|quantity|list) )+",
    "list": "(name )?(description )?((list|quantity) )+",
    "quantity": "(name )?(description )?(si:real|si:realListXMLList) (measurementMetaData )?",
    "measurementMetaData": "(metaData )+",
    "text": "(content )+",
    "si:real": "si:value si:unit (si:measurementUncertaintyUnivariate )?",
    "si:realListXMLList": "si:valueXMLList si:unitXMLList ",
    "si:measurementUncertaintyUnivariate": "(si:standardMU|si:expandedMU) ",
    "si:standardMU": "si:valueStandardMU ",
    "si:expandedMU": "si:valueExpandedMU si:coverageFactor si:coverageProbability ",
}
# The type of an element, where it is not its own name.
TYPES = {
    "dccSoftware": "softwareList",
    "usedSoftware": "softwareList",
    "customer": "contact",
    "person": "contactNotStrict",
    "manufacturer": "contactNotStrict",
    "measuringEquipmentQuantity": "primitiveQuantity",
    "metaData": "statement",
    "name": "text",
    "description": "text",
    "declaration": "text",
    "further": "text",
}
_DECIMAL = r"[-+]?(\d*\.\d+|\d+\.\d*|\d+)([Ee][-+]?\d+)?"
_NOT_EMPTY, _DATE, _CONFORMITY = (
    r"\S+(\s+\S+)*",
    r"\d{4}-\d\d-\d\d",
    "pass|fail|conditionalPass|conditionalFail|noPass|noFail",
)
TEXTS = {
    "content": r"[\s\S]*",
    "release": _NOT_EMPTY,
    "type": "application|bios|driver|editor|firmware|library|os|other",
    "countryCodeISO3166_1": "[A-Z]{2}",
    "countryCode": "[A-Z]{2}",
    "usedLangCodeISO639_1": "[a-z]{2}",
    "mandatoryLangCodeISO639_1": "[a-z]{2}",
    "uniqueIdentifier": _NOT_EMPTY,
    "typeOfChange": "amended|substituted",
    "replacedUniqueIdentifier": _NOT_EMPTY,
    "receiptDate": _DATE,
    "beginPerformanceDate": _DATE,
    "endPerformanceDate": _DATE,
    "issueDate": _DATE,
    "performanceLocation": "laboratory|customer|laboratoryBranch|customerBranch|other",
    "issuer": "manufacturer|calibrationLaboratory|customer|owner|other",
    "value": _NOT_EMPTY,
    "model": _NOT_EMPTY,
    "calibrationLaboratoryCode": _NOT_EMPTY,
    "eMail": _NOT_EMPTY,
    "phone": _NOT_EMPTY,
    "city": _NOT_EMPTY,
    "postCode": _NOT_EMPTY,
    "street": _NOT_EMPTY,
    "role": _NOT_EMPTY,
    "mainSigner": "true|false",
    "norm": _NOT_EMPTY,
    "conformity": _CONFORMITY,
    "status": "beforeAdjustment|afterAdjustment|beforeRepair|afterRepair",
    "si:value": _DECIMAL,
    "si:unit": r"(\\\w+(\{-?\d+\})?)+",
    "si:valueXMLList": rf"{_DECIMAL}( {_DECIMAL})*",
    "si:unitXMLList": r"(\\\w+(\{-?\d+\})?)+( (\\\w+(\{-?\d+\})?)+)*",
    "si:valueStandardMU": _DECIMAL.removeprefix("[-+]?"),
    "si:valueExpandedMU": _DECIMAL.removeprefix("[-+]?"),
    "si:coverageFactor": r"[1-9]\d*(\.\d*)?",
    "si:coverageProbability": r"0(\.\d*)?|1(\.0*)?",
}
ATTRIBUTES = {"content": {"lang"}, "quantity": {"refType"}, "usedMethod": {"refType"}}


def faults(text: str) -> list[str]:
    """Where a certificate breaks the content model; nothing if it keeps it."""
    root = ElementTree.fromstring(text.encode())
    found: list[str] = []
    if root.get("schemaVersion") != "3.3.0":
        found.append(f"schemaVersion is {root.get('schemaVersion')}")
    _check(root, "", found)
    return found


def _name(element: ElementTree.Element) -> str:
    return element.tag.replace(DCC, "").replace(SI, "si:")


def _check(element: ElementTree.Element, path: str, found: list[str]) -> None:
    name = _name(element)
    where = f"{path}/{name}"
    wrong = set(element.attrib) - ATTRIBUTES.get(name, set())
    if path and wrong:
        found.append(f"{where} has the attributes {sorted(wrong)}")
    kind = TYPES.get(name, name)
    if kind not in CHILDREN:
        if len(element) or not re.fullmatch(TEXTS.get(name, r"(?!)"), element.text or ""):
            found.append(f"{where} is {element.text!r}")
        return
    children = "".join(f"{_name(child)} " for child in element)
    if not re.fullmatch(CHILDREN[kind], children) or (element.text or "").strip():
        found.append(f"{where} has the children {children}")
    for child in element:
        _check(child, where, found)
