"""Formulas as MathML, which every browser shows by itself: no script, and nothing loaded over a network."""

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.util import logging
from sphinx.util.docutils import SphinxTranslator


def _converted(node, display: str) -> str:
    """The MathML of a formula; a command that the converter does not know, which it leaves as it is, is warned of."""
    formula = convert(node.astext(), display=display)
    if "\\" in formula:
        logging.getLogger(__name__).warning("a formula has a command that cannot be shown: %s", node.astext())
    return formula.replace("<mo>&#x02016;</mo>", '<mo stretchy="false">&#x02016;</mo>')  # else each as tall as it likes


def _inline(translator: SphinxTranslator, node) -> None:
    translator.body.append(_converted(node, "inline"))
    raise nodes.SkipNode


def _block(translator: SphinxTranslator, node) -> None:
    translator.body.append(translator.starttag(node, "div", CLASS="math"))
    if node["number"]:
        translator.body.append(f'<span class="eqno">({node["number"]})')
        translator.add_permalink_ref(node, "Link to this equation")
        translator.body.append("</span>")
    translator.body.append(_converted(node, "block") + "</div>\n")
    raise nodes.SkipNode


def setup(app) -> dict[str, object]:
    """Called by Sphinx."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
