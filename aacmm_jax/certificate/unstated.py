"""What a certificate does not state although it could."""

from ..files.administrative_data import AdministrativeData
from .measurement_results import LENGTHS_OF_NONE
from .sections import content
from .xml_elements import PREFIXES, root_of


def unstated(dcc: str, given: AdministrativeData) -> list[str]:
    """Sentences on what a certificate, of these administrative data, does not state: conformity where limits were
    given, and what readers look for."""
    root, sentences, keys = root_of(dcc), [], given.not_stated()
    if given.conformity is None and root.find(".//dcc:metaData/dcc:conformity", PREFIXES) is not None:
        sentences.append("No statement of conformity: add [conformity] with verdict and specification (--about).")
    equipment = (content(x, "dcc:name") for x in root.iterfind(".//dcc:measuringEquipment", PREFIXES))
    if given.reference and not {*LENGTHS_OF_NONE}.isdisjoint(equipment):
        keys.append("reference.lengths")
    return sentences + ([f"Not stated: {', '.join(keys)} (--about)."] if keys else [])
