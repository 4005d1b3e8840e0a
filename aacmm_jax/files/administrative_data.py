"""Administrative data of a certificate (DCC's term), in TOML: laboratory, customer, item, persons and dates."""

import datetime
import itertools
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, FiniteFloat, model_validator

from ..acceptance.judgement import RULES, Rule
from ..core.errors import InputError
from .inputs import open_input
from .toml import Strict, read_toml

NOT_STATED = "not stated"
NO_COUNTRY = "ZZ"  # reserved for users by ISO 3166-1: a certificate must have a country code, and none was given

_LOOKED_FOR = {  # ISO/IEC 17025:2017, 7.8.2.1
    "laboratory": ("name", "city"),
    "customer": ("name", "city"),
    "item": ("name", "manufacturer", "model", "serial_number", "condition"),
    "certificate": ("number", "received", "begin", "issued", "temperature_celsius"),
}
_LARGEST_LOGO, _MOST_PIXELS, _PNG = 1_000_000, 10_000_000, b"\x89PNG\r\n\x1a\n"  # bytes, pixels
# All but the characters of XML 1.0, production 2.
# What people call the decision rules; both editions of ISO 14253-1 where none is named.
_CALLED: dict[Rule, str] = {
    "iso-2017": "iso-2017|14253(?!.*2013)",
    "iso-2013": "iso-2013|14253(?!.*2017)",
    "simple": r"simple|einfache|b89\.7\.3\.1|shared risk",
}
_NOT_IN_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def held_by_xml(text: str, what: str) -> str:
    """The same text, or `InputError` where it has a character that XML 1.0 cannot hold; ``what`` names the text."""
    character = _NOT_IN_XML.search(text)
    if character:
        raise InputError(
            f"{what} contains the character U+{ord(character.group()):04X}, which XML does not allow; remove the "
            "character."
        )
    return text


def _text(text: str) -> str:
    """Text without blanks around it, as the schema of the DCC requires."""
    text = held_by_xml(text, "the text").strip(" \t\n\r")
    if not text:
        raise ValueError("the text is empty; enter text or remove the key.")
    return text


def _country(code: str) -> str:
    if not re.fullmatch("[A-Z]{2}", code):
        raise ValueError(f"{code!r} is not a country code of ISO 3166-1; give two capital letters, for example DE.")
    return code


Text = Annotated[str, AfterValidator(_text)]
Country = Annotated[str, AfterValidator(_country)]
Date = Annotated[datetime.date, Field(strict=False)]  # also in quotes


class Contact(Strict):
    """A laboratory's or a customer's name and address. ``country`` is a code of ISO 3166-1: two capital letters."""

    name: Text = NOT_STATED
    street: Text | None = None
    postal_code: Text | None = None
    city: Text | None = None
    country: Country | None = None
    email: Text | None = None
    phone: Text | None = None


class Laboratory(Contact):
    """The calibration laboratory; ``code`` is what its accreditation body calls it, ``logo`` a PNG or SVG file, whose
    path starts at the folder of the TOML file."""

    code: Text | None = None
    logo: Text | None = None


class CalibratedItem(Strict):
    """The arm that was calibrated; without a name, it is called as in its arm file."""

    name: Text | None = None
    manufacturer: Text | None = None
    model: Text | None = None
    serial_number: Text | None = None
    customer_number: Text | None = None  # what the customer calls it by
    condition: Text | None = None  # in which it came in


class Person(Strict):
    """A person responsible for the certificate."""

    name: Text
    role: Text | None = None
    main_signer: bool = False


class Reference(Strict):
    """A reference artefact that the lengths are between: gauge block, ball bar, plate."""

    name: Text
    manufacturer: Text | None = None
    model: Text | None = None
    serial_number: Text | None = None
    certificate_number: Text | None = None  # of its own calibration
    lengths: list[Text] = Field(default_factory=list)  # START - END, names of sockets, or patterns of these


class Certificate(Strict):
    """Number, dates and conditions; without dates, begin and end are the day on which the calibration was computed."""

    number: Text | None = None
    replaces: Text | None = None  # number of the certificate that this one takes the place of
    country: Country | None = None  # where it is issued; by default the laboratory's
    received: Date | None = None  # when the arm came in
    begin: Date | None = None
    end: Date | None = None
    issued: Date | None = None
    place: Literal["laboratory", "customer", "laboratoryBranch", "customerBranch", "other"] = "other"
    remarks: Text | None = None
    temperature_celsius: FiniteFloat | None = None
    temperature_u_celsius: Annotated[FiniteFloat, Field(ge=0)] | None = None  # standard uncertainty

    @model_validator(mode="after")
    def _in_order(self) -> "Certificate":
        dates = [(name, getattr(self, name)) for name in ("received", "begin", "end", "issued")]
        given = [(name, date) for name, date in dates if date is not None]
        for (earlier, first), (later, second) in itertools.pairwise(given):
            if first > second:
                raise ValueError(f"{earlier} ({first}) is after {later} ({second}); correct one of these dates.")
        if self.temperature_u_celsius is not None and self.temperature_celsius is None:
            raise ValueError("temperature_u_celsius is given without temperature_celsius; give both.")
        return self


class Conformity(Strict):
    """A statement of conformity: the verdict, the specification it is about, and the rule by which it was decided.

    The rule is that of the evaluation; ``decision_rule`` may add to it, but not name another one.
    """

    verdict: Literal["pass", "fail", "conditionalPass", "conditionalFail", "noPass", "noFail"]
    specification: Text
    decision_rule: Text | None = None

    def decided_by(self, rules: Sequence[Rule]) -> str:
        """The rules of an evaluation in words, and what is stated about them besides."""
        words = "; ".join(dict.fromkeys(RULES[rule] for rule in rules))
        stated = self.decision_rule or ""
        return words if stated in words else "; ".join(filter(None, (words, stated)))


class AdministrativeData(Strict):
    """The administrative data of a certificate. All are optional; the certificate says what is not stated.

    Example:
        >>> data = aj.files.AdministrativeData(item={"name": "Measuring arm", "serial_number": "7125-0042"})
        >>> print(data.laboratory.name, "/", data.item.serial_number)
        not stated / 7125-0042
    """

    laboratory: Laboratory = Laboratory()
    customer: Contact = Contact()
    item: CalibratedItem = CalibratedItem()
    person: list[Person] = Field(default_factory=list)
    certificate: Certificate = Certificate()
    reference: list[Reference] = Field(default_factory=list)
    conformity: Conformity | None = None

    @property
    def country(self) -> str:
        """Country code of the certificate."""
        return self.certificate.country or self.laboratory.country or NO_COUNTRY

    def not_stated(self) -> list[str]:
        """Keys of what a reader looks for in a certificate, and what is not stated, such as ``item.manufacturer``."""
        of = ((table, key, getattr(getattr(self, table), key)) for table, keys in _LOOKED_FOR.items() for key in keys)
        keys = [f"{table}.{key}" for table, key, value in of if value in (None, NOT_STATED)]
        keys += [] if "place" in self.certificate.model_fields_set else ["certificate.place"]
        return keys + [name for name in ("person", "reference") if not getattr(self, name)]


def read_administrative_data(path: str | os.PathLike) -> AdministrativeData:
    """Read the administrative data of a certificate.

    Args:
        path: a TOML file with the tables ``[laboratory]``, ``[customer]``, ``[item]``, ``[[person]]``,
            ``[certificate]``, ``[[reference]]`` and ``[conformity]``, each of them optional.

    Example:
        >>> from pathlib import Path
        >>> _ = Path("laboratory.toml").write_text('laboratory = { name = "Metrology", city = "Braunschweig" }')
        >>> print(aj.files.read_administrative_data("laboratory.toml").laboratory.city)
        Braunschweig
    """
    return read_toml(path, AdministrativeData)


def read_logo(path: str | os.PathLike) -> bytes | None:
    """Read the logo that a file of administrative data names, None where it names none.

    `InputError` if it is not a PNG or SVG file of at most 1 MB and 10 million pixels.

    Args:
        path: The TOML file (`read_administrative_data`).

    Example:
        >>> from pathlib import Path
        >>> _ = Path("laboratory.toml").write_text('laboratory = { name = "Metrology" }')
        >>> print(aj.files.read_logo("laboratory.toml"))
        None
    """
    named = read_administrative_data(path).laboratory.logo
    if named is None:
        return None
    logo = Path(path).parent / named
    with open_input(logo) as stream:
        content = stream.read(_LARGEST_LOGO + 1)
    png = content.startswith(_PNG)
    if not (png or b"<svg" in content[:4096]) or len(content) > _LARGEST_LOGO:
        raise InputError(f"{logo} is not a PNG or SVG file of at most 1 MB; give another file as laboratory.logo.")
    width, height = (int.from_bytes(content[i : i + 4]) for i in (16, 20))
    if png and width * height > _MOST_PIXELS:
        raise InputError(f"{logo} has {width} x {height} pixels; give a logo of at most 10 million pixels.")
    return content


def check_conformity(
    about: AdministrativeData,
    *,
    simulated: bool,
    decision: str | None = None,
    rules: Sequence[Rule] = (),
    needed: str = "",
) -> None:
    """Refuse a statement of conformity of a simulated arm, one without a test in the file (``needed``: what would be
    one), and one that contradicts the decision of the tests or names another rule than theirs."""
    if about.conformity is None:
        return
    verdict = about.conformity.verdict
    if simulated:
        raise InputError("conformity cannot be stated for a simulated arm; remove [conformity].")
    if needed:
        raise InputError(
            f"conformity is stated, but there are no acceptance results to support it; {needed}, or remove "
            "[conformity]."
        )
    results = {"conforms": "every limit is met", "fails": "a limit is not met", "undecided": "a limit is undecided"}
    passes = {"pass": ("conforms",), "fail": ("fails",)}.get(verdict, tuple(results))
    if decision not in passes:
        raise InputError(
            f"conformity.verdict is '{verdict}', but in this evaluation "
            f"{results.get(decision or '', 'no limit was given')}; correct the verdict."
        )
    stated = about.conformity.decision_rule or ""
    named = {rule for rule, called in _CALLED.items() if re.search(called, stated, re.IGNORECASE)}
    if rules and named and named.isdisjoint(rules):
        raise InputError(
            f"conformity.decision_rule is '{stated}', but the evaluation was decided by "
            f"{'; '.join(RULES[rule] for rule in dict.fromkeys(rules))}; remove decision_rule, or evaluate again with "
            f"--rule {min(named)}."
        )
