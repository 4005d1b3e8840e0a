"""The role ``{source}`model/robust:Loss.along` ``: the name of a function, linked to the file that contains it."""

import importlib
from functools import reduce


def function_of(target: str) -> object:
    """What a target names, such as ``model/robust:Loss.along``; raises `ImportError` or `AttributeError` without it."""
    module, name = target.split(":")
    return reduce(getattr, name.split("."), importlib.import_module(f"aacmm_jax.{module.replace('/', '.')}"))


def source(name: str, raw: str, text: str, line: int, inliner, options=None, content=()):
    """A link to a file of the package, beside the site; a name that does not exist is a warning."""
    from docutils import nodes
    from sphinx import addnodes

    try:
        function_of(text)
    except (ImportError, AttributeError, ValueError) as error:
        return [], [inliner.reporter.error(f"{text} names nothing: {error}", line=line)]
    module, function = text.split(":")
    target = {"refdoc": inliner.document.settings.env.docname, "reftarget": f"/../aacmm_jax/{module}.py"}
    return [addnodes.download_reference("", "", nodes.literal("", function), **target)], []


def setup(app) -> dict[str, object]:
    """Called by Sphinx."""
    app.add_role("source", source)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
