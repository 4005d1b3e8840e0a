"""The standards that the acceptance tests follow: their names, and the editions that the secondary sources describe."""

from typing import Literal

JJF_1408, ASME_B89_4_22, ISO_10360_12 = "JJF 1408", "ASME B89.4.22", "ISO 10360-12"
EDITIONS = {JJF_1408: "JJF 1408-2013", ASME_B89_4_22: "ASME B89.4.22-2004", ISO_10360_12: "ISO 10360-12:2016"}
Planned = Literal["asme", "iso"]  # standards whose procedure can be planned, as arguments name them
PLANNED: dict[Planned, str] = {"asme": ASME_B89_4_22, "iso": ISO_10360_12}
