"""Words of the printed certificate, one TOML file a language."""

import os
import re
from pathlib import Path
from typing import Annotated, NamedTuple

from pydantic import AfterValidator, Field

from ...core.errors import InputError
from ...files.administrative_data import NOT_STATED, Text
from ...files.toml import Strict, read_toml

_FOLDER = Path(__file__).parent
_NAMED = re.compile(r"\{(\w+)\}")


def _code(text: str) -> str:
    if not re.fullmatch("[a-z]{2}", text):
        raise ValueError(f"{text!r} is not a language code of ISO 639-1; give two small letters, for example fr.")
    return text


def _day(text: str) -> str:
    if sorted(_NAMED.findall(text)) != ["day", "month", "year"]:
        raise ValueError(f"{text!r} is not a form of a date; write {{day}}, {{month}} and {{year}} in it, once each.")
    return text


class _File(Strict):
    code: Annotated[str, AfterValidator(_code)]
    decimal: Text
    day: Annotated[Text, AfterValidator(_day)]
    labels: dict[str, Text]
    sentences: dict[str, Text]
    counts: dict[str, Text]
    places: dict[str, Text]
    verdicts: dict[str, Text]
    rules: dict[str, Text]
    terms: dict[str, Text]
    kinds: dict[str, Text]
    metrics: dict[str, Text]
    missing: dict[str, Text] = Field(default_factory=dict)
    reasons: dict[str, Text] = Field(default_factory=dict)


_GROUPS = tuple(name for name in _File.model_fields if name not in ("code", "decimal", "day", "missing", "reasons"))
# Of keys that other groups have as well.
_SUFFIXED = {"sentences": "{}_sentence", "places": "place_{}", "kinds": "kind_{}", "metrics": "metric_{}"}


class Language(NamedTuple):
    """The texts of a language by their keys; called with a key and what stands in braces, it is the text."""

    code: str
    decimal: str
    day: str  # form of a date
    texts: dict[str, str]
    missing: tuple[tuple[re.Pattern[str], str], ...] = ()  # English sentences and what they are in this language
    reasons: tuple[tuple[re.Pattern[str], str], ...] = ()  # for which poses were left out, likewise

    def __call__(self, key: str, **values: str) -> str:
        """The text of a key, with values for the names in its braces."""
        text = _NAMED.sub(lambda match: values.get(match[1], match[0]), self.texts[key])
        return text.replace(" %", "\u00a0%")

    def known(self, key: str, otherwise: str) -> str:
        """The text of a key, or another where this language has none."""
        return self(key) if key in self.texts else otherwise

    def counted(self, key: str, number: str) -> str:
        """The text of a key with a number; "one | several" where they differ."""
        forms = self(key, number=number).split(" | ")
        return forms[0 if number == "1" else -1]

    def translated(self, sentences: str) -> str:
        """Sentences on what a procedure lacks; "" where this language does not have one of them."""
        if self.code == "en":
            return sentences
        translated, end = [], 0
        while end < len(sentences):
            matches = [(match, text) for pattern, text in self.missing if (match := pattern.match(sentences, end))]
            if not matches:
                return ""
            # Texts in braces may reach over several sentences: the shortest match is one.
            match, text = min(matches, key=lambda found: found[0].end())
            numbers = {name[1:]: self.number(value) for name, value in match.groupdict().items()}
            translated.append(_NAMED.sub(lambda name, numbers=numbers: numbers[name[1]], text))
            end = match.end()
        return " ".join(translated).replace(" %", "\u00a0%")

    def reason(self, finding: str) -> str:
        """For which reason a finding says that poses were left out; "" where this language does not have it."""
        for pattern, text in self.reasons:
            if match := pattern.search(finding):
                of = {name[1:]: value for name, value in match.groupdict().items()}
                of = {name: self.number(x) if re.fullmatch(r"-?[\d.]+", x) else x for name, x in of.items()}
                return _NAMED.sub(lambda name, of=of: of[name[1]], text)
        return ""

    def stated(self, text: str) -> str:
        """A text, or that it is not stated, in this language."""
        return self("not_stated") if text in ("", NOT_STATED) else text

    def date(self, text: str) -> str:
        """A date of ISO 8601 as this language writes it, "" where there is none."""
        parts: dict[str, str] = dict(zip(("year", "month", "day"), text.split("-"), strict=False))
        return _NAMED.sub(lambda match: parts[match[1]], self.day) if len(parts) == 3 else text

    def number(self, text: str) -> str:
        """A number, or several, with this language's decimal sign and a proper minus."""
        return text.replace(".", self.decimal).replace("-", "−")


def language_of(named: str | os.PathLike) -> Language:
    """A language that comes with the package ("en", "de"), or that of a TOML file. Raises `InputError`."""
    shipped = sorted(path.stem for path in _FOLDER.glob("*.toml"))
    path = _FOLDER / f"{named}.toml" if str(named) in shipped else Path(named)
    if path.suffix != ".toml":
        raise InputError(
            f"'{named}' is not a language of the certificate; choose {' or '.join(shipped)}, or give a TOML file."
        )
    content, english = read_toml(path, _File), read_toml(_FOLDER / "en.toml", _File)
    texts = {}
    for group in _GROUPS:
        given, wanted = getattr(content, group), getattr(english, group)
        for key in (*wanted, *given):
            if key not in given or key not in wanted:
                raise InputError(f"{path}: [{group}] {'lacks' if key in wanted else 'has the unknown key'} {key!r}.")
            if set(_NAMED.findall(given[key])) != set(_NAMED.findall(wanted[key])):
                raise InputError(f"{path}: [{group}] {key!r} needs the same names in braces as {wanted[key]!r}.")
            texts[_SUFFIXED.get(group, "{}").format(key)] = given[key]
    for table, sentences in (("missing", content.missing), ("reasons", content.reasons)):
        for key, text in sentences.items():
            if not set(_NAMED.findall(text)) <= set(_NAMED.findall(key)):
                raise InputError(f"{path}: [{table}] {text!r} has other names in braces than {key!r}.")
    missing = [(_pattern(key, ".+?", "", r"(?:\s|$)"), text) for key, text in content.missing.items()]
    reasons = [
        (_pattern(key, "[^()]+?", r"\(", r"\), which contradict"), text) for key, text in content.reasons.items()
    ]
    return Language(content.code, content.decimal, content.day, texts, tuple(missing), tuple(reasons))


def _pattern(sentence: str, any_text: str, before: str, after: str) -> re.Pattern[str]:
    """A regular expression of a sentence with any texts in its braces, between two others."""
    parts = _NAMED.split(sentence)
    texts = [re.escape(part) if i % 2 == 0 else f"(?P<n{part}>{any_text})" for i, part in enumerate(parts)]
    return re.compile(before + "".join(texts) + after, flags=re.DOTALL)
