"""The role ``{source}`model/robust:Loss.along` ``: the name of a function, linked to the file that contains it."""

import importlib
from functools import reduce

from docutils import nodes
from sphinx import addnodes
from sphinx.util.docutils import SphinxRole


def function_of(target: str) -> object:
    """What a target names, such as ``model/robust:Loss.along``; raises `ImportError` or `AttributeError` without it."""
    module, name = target.split(":")
    return reduce(getattr, name.split("."), importlib.import_module(f"aacmm_jax.{module.replace('/', '.')}"))


class SourceRole(SphinxRole):
    """A link to a file of the package, beside the site; a name that does not exist is a warning."""

    def run(self) -> tuple[list[nodes.Node], list[nodes.system_message]]:
        """The link, or what is wrong with the name."""
        try:
            function_of(self.text)
        except (ImportError, AttributeError, ValueError) as error:
            return [], [self.inliner.reporter.error(f"{self.text} names nothing: {error}", line=self.lineno)]
        module, name = self.text.split(":")
        target = {"refdoc": self.env.docname, "reftarget": f"/../aacmm_jax/{module}.py"}
        return [addnodes.download_reference("", "", nodes.literal("", name), **target)], []


def setup(app) -> dict[str, object]:
    """Called by Sphinx."""
    app.add_role("source", SourceRole())
    return {"parallel_read_safe": True, "parallel_write_safe": True}
