"""Settings of the site, which `bash tools/site.sh` builds with Sphinx."""

import os
import re
from pathlib import Path

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx

import nmr

project = "nmr + learn3d"
author = "the authors of nmr and learn3d"
release = nmr.__version__
html_title = f"nmr + learn3d {release}"

extensions = ["myst_nb", "sphinx.ext.autodoc", "numpydoc"]
exclude_patterns = ["_build", "examples/README.md"]  # show_gallery has the latter
default_role = "literal"  # `name` in a docstring

highlight_language = "none"  # blocks without a language are drawings and tables
myst_heading_anchors = 4  # [text](page.md#a-heading), as in the repository's view
nb_merge_streams = True
nb_execution_mode = "off"  # notebooks are shown with the outputs that they carry; tests/test_examples.py runs them

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # docstrings say types and shapes
numpydoc_show_class_members = False
python_maximum_signature_line_length = 80

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_copyright = False
html_show_sphinx = False


def show_gallery(app: Sphinx, page: str, text: list[str]) -> None:
    """Put docs/examples/README.md, whose links are relative to its folder, on the start page in place of the link."""
    if page == "index":
        gallery = Path(app.srcdir) / "examples" / "README.md"
        app.env.note_dependency(gallery)
        body = re.sub(r"\]\((?!\w+:|#)", "](examples/", "#" + gallery.read_text())
        text[0] = text[0].replace("[Gallery](examples/README.md)", body)
    else:
        text[0] = re.sub(
            r"\]\((?:\.\./)?examples/README\.md\)", f"]({'../' * page.count('/')}index.md#gallery)", text[0]
        )


def hand_out_files(app: Sphinx, doctree: nodes.document) -> None:
    """Links to Markdown files outside of docs become downloads. MyST does the same with links to all other files."""
    for link in list(doctree.findall(addnodes.pending_xref)):
        target = Path(f"{link['reftarget']}.md")
        if link.get("refdomain") == "doc" and target.is_absolute() and target.is_file():
            relative = os.path.relpath(target, Path(app.env.doc2path(link["refdoc"])).parent)
            link.replace_self(addnodes.download_reference("", *link.children, reftarget=relative))


def setup(app: Sphinx) -> None:
    app.connect("source-read", show_gallery)
    app.connect("doctree-read", hand_out_files, priority=400)  # before Sphinx collects the downloads
