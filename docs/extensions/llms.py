"""Text for assistants beside the site: `llms.txt`, an index of the pages, and `llms-full.txt`, the Markdown of all.

The index has one line for each page, under the captions of the contents: its title and its first sentence.
"""

import re
from pathlib import Path

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx

SENTENCE = re.compile(r"^.*?[.:?](?=\s|$)", flags=re.DOTALL)


def _first_sentence(app: Sphinx, page: str) -> str:
    for paragraph in app.env.get_doctree(page).findall(nodes.paragraph):
        text = " ".join(paragraph.astext().split())
        if isinstance(paragraph.parent, nodes.entry):  # of a table
            continue
        if found := SENTENCE.match(text):
            return found.group().rstrip(":.") + "."
    return ""


def _index(app: Sphinx) -> str:
    main = app.config.root_doc
    lines = [f"# {app.config.project}", "", f"> {_first_sentence(app, main)}"]
    for tree in app.env.get_doctree(main).findall(addnodes.toctree):
        lines += ["", f"## {tree['caption'] or 'Contents'}", ""]
        for title, page in tree["entries"]:
            if page in app.env.titles:
                uri = app.builder.get_target_uri(page)
                lines.append(f"- [{title or app.env.titles[page].astext()}]({uri}): {_first_sentence(app, page)}")
    return "\n".join(lines) + "\n"


def _write(app: Sphinx, error: Exception | None) -> None:
    if error or app.builder.name != "html":
        return
    index = _index(app)
    pages = sorted(page for page in app.env.found_docs if str(app.env.doc2path(page)).endswith(".md"))
    texts = [f"<!-- {page} -->\n\n{Path(app.env.doc2path(page)).read_text('utf-8').strip()}\n" for page in pages]
    Path(app.outdir, "llms.txt").write_text(index, encoding="utf-8")
    Path(app.outdir, "llms-full.txt").write_text(index + "\n" + "\n".join(texts), encoding="utf-8")


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("build-finished", _write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
