"""What readers with a keyboard or a screen reader need, and Sphinx leaves out: levels of captions, focus of code."""


def _complete(app, page: str, template: str, context: dict, tree: object) -> None:
    """Captions in the list of pages get a level; code that is wider than the page can be scrolled by keys."""
    for part in ("furo_navigation_tree", "body"):
        if context.get(part):
            text = context[part].replace('role="heading">', 'role="heading" aria-level="2">')
            context[part] = text.replace("<pre>", '<pre tabindex="0">')


def setup(app) -> dict[str, object]:
    """Called by Sphinx; after Furo, which makes the list of pages."""
    app.connect("html-page-context", _complete, priority=900)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
