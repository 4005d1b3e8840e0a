"""What readers with a keyboard or a screen reader need, and Sphinx leaves out.

Captions in the list of pages get a level, code that is wider than the page can be scrolled by keys, and the arguments
of a long signature are no list within a term.
"""

import re

ARGUMENTS = re.compile(r'<dl>\n((?:<dd><em class="sig-param">.*?</dd>\n)+)</dl>', flags=re.DOTALL)


def _lines(arguments: re.Match[str]) -> str:
    return arguments[1].replace("<dd>", '<span class="argument">').replace("</dd>", "</span>")


def _complete(app, page: str, template: str, context: dict, tree: object) -> None:
    for part in ("furo_navigation_tree", "body"):
        if context.get(part):
            text = context[part].replace('role="heading">', 'role="heading" aria-level="2">')
            text = text.replace("<pre>", '<pre tabindex="0">')
            context[part] = ARGUMENTS.sub(_lines, text)


def setup(app) -> dict[str, object]:
    """Called by Sphinx; after Furo, which makes the list of pages."""
    app.connect("html-page-context", _complete, priority=900)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
