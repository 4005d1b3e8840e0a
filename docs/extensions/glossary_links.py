"""The first use of a term of the glossary on each page is a link to what it means."""

import re

from docutils import nodes
from sphinx.application import Sphinx

# Words of everyday language, which every page uses, and letters.
LEFT_OUT = {"cell", "k", "nominal", "pose", "target", "transform", "u, U", "free parameter", "fixed parameter"}
GUIDES = re.compile(
    r"(start|which_data|troubleshooting|reading_a_report|warnings)$|(readers|how_to|explanation|evidence)/"
)
NOT_INSIDE = (nodes.reference, nodes.literal, nodes.title, nodes.math, nodes.strong, nodes.image)


def _terms(app: Sphinx, page: str) -> dict[str, str]:
    """Addresses of the terms as seen from a page, by the words in lower case."""
    return {
        name.lower(): f"{app.builder.get_relative_uri(page, where)}#{label}"
        for (kind, name), (where, label) in app.env.domains.standard_domain.objects.items()
        if kind == "term" and name not in LEFT_OUT
    }


def _linked(text: str, match: re.Match[str], address: str) -> list[nodes.Node]:
    link = nodes.reference("", match[0], refuri=address, internal=True, classes=["term-link"])
    parts = [nodes.Text(text[: match.start()]), link, nodes.Text(text[match.end() :])]
    return [part for part in parts if part.astext()]


def _link(app: Sphinx, tree: nodes.document, page: str) -> None:
    if app.builder.format != "html" or not GUIDES.match(page):
        return
    terms = _terms(app, page)
    for paragraph in tree.findall(nodes.paragraph):
        for node in list(paragraph.findall(nodes.Text)):
            if not terms or any(isinstance(parent, NOT_INSIDE) for parent in _parents(node)):
                continue
            words = "|".join(sorted(map(re.escape, terms), key=len, reverse=True))
            if match := re.search(rf"\b({words})s?\b", node.astext(), flags=re.IGNORECASE):
                node.parent.replace(node, _linked(node.astext(), match, terms.pop(match[1].lower())))


def _parents(node: nodes.Node) -> list[nodes.Node]:
    parents = []
    while (node := node.parent) is not None:
        parents.append(node)
    return parents


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("doctree-resolved", _link)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
