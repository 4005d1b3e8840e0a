"""Who calibrated what for whom, as people stated it."""

from typing import Any

from .parts import Section, Table, text

_WORDS = {
    "laboratory": "Laboratory",
    "customer": "Customer",
    "item": "Item",
    "certificate": "Certificate",
    "conformity": "Statement of conformity",
}


def about_section(about: Any) -> Section:
    """What an `about.About` states; what it leaves out is not mentioned."""
    stated = about.model_dump(exclude_unset=True)
    rows = [
        [text(title), text(key.replace("_", " ")), text(value)]
        for part, title in _WORDS.items()
        for key, value in (stated.get(part) or {}).items()
        if value is not None
    ]
    for part, title in (("person", "Responsible"), ("reference", "Reference artefact")):
        for entry in stated.get(part) or []:
            rows.append([text(title), text("name"), text(entry["name"])])
            rows += [
                [text(""), text(key.replace("_", " ")), text(value)]
                for key, value in entry.items()
                if key != "name" and value is not None
            ]
    return Section("about", "Laboratory, customer and item", [Table("As stated", ("", "", ""), rows)])
