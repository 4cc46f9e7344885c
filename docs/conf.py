"""Settings of the site, which `bash tools/site.sh` builds with Sphinx."""

import inspect
import json
import os
import re
from pathlib import Path
from typing import Any

from docutils import nodes
from numpydoc.docscrape import FunctionDoc, NumpyDocString, Parameter
from sphinx import addnodes
from sphinx.application import Sphinx

import nmr

project = "nmr + learn3d"
author = "the authors of nmr and learn3d"
release = nmr.__version__
html_title = f"nmr + learn3d {release}"

extensions = ["myst_nb", "sphinx.ext.autodoc", "numpydoc", "sphinx_copybutton"]
# show_gallery has the gallery; logs are downloads
exclude_patterns = [
    "_build",
    "examples/README.md",
    "log",
]
default_role = "literal"  # `name` in a docstring

highlight_language = "none"  # blocks without a language are drawings and tables
myst_heading_anchors = 4  # [text](page.md#a-heading), as in the repository's view
nb_merge_streams = True
# notebooks are shown with the outputs that they carry; tests/test_examples.py runs them
nb_execution_mode = "off"

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_type_aliases = {"Meshes": "Meshes"}  # described at the parameter
copybutton_prompt_text = r">>> |\.\.\. "
copybutton_prompt_is_regexp = True
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
            r"\]\((?:\.\./)?examples/README\.md\)",
            f"]({'../' * page.count('/')}index.md#gallery)",
            text[0],
        )


def offer_colab(app: Sphinx, page: str, text: list[str]) -> None:
    """Put a link to Google Colab above each notebook, if the site is built by GitHub, which names the repository."""
    repository = os.environ.get("GITHUB_REPOSITORY")
    if repository and Path(app.env.doc2path(page)).suffix == ".ipynb":
        address = (
            f"https://colab.research.google.com/github/{repository}/blob/main/docs/{page}.ipynb"
        )
        folder = repository.rpartition("/")[2]
        first = (
            f"!git clone -q https://github.com/{repository} && pip install -q './{folder}[train]'"
        )
        notebook = json.loads(text[0])
        lines = [
            f"[Open in Colab]({address}), and run this in a new first cell:\n",
            "```\n",
            f"{first}\n",
        ]
        lines += [f"%cd {folder}/docs/examples\n", "```"]
        cell = {"cell_type": "markdown", "id": "colab", "metadata": {}, "source": lines}
        notebook["cells"].insert(1, cell)  # below the title
        text[0] = json.dumps(notebook)


def hand_out_files(app: Sphinx, doctree: nodes.document) -> None:
    """Links to Markdown files that are no pages become downloads. MyST does the same with links to all other files."""
    for link in list(doctree.findall(addnodes.pending_xref)):
        if link.get("refdomain") != "doc" or link["reftarget"] in app.env.found_docs:
            continue
        # outside of docs, the target is absolute
        target = Path(app.srcdir) / f"{link['reftarget']}.md"
        if target.is_file():
            relative = os.path.relpath(target, Path(app.env.doc2path(link["refdoc"])).parent)
            link.replace_self(
                addnodes.download_reference("", "", *link.children, reftarget=relative)
            )


def parameter_texts(function: Any) -> dict[str, Parameter]:
    """The texts of a function's parameters by name, without those that refer to another function."""
    entries = [
        entry
        for entry in FunctionDoc(function)["Parameters"]
        if not entry.desc[0].startswith("As :func:")
    ]
    return {name: entry for entry in entries for name in entry.name.split(", ")}


def explain_all_parameters(
    app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]
) -> None:
    """Complete the parameters of the drawing functions: their docstrings leave the common ones to `render`."""
    if what != "function" or getattr(thing, "__module__", "") not in ("nmr.render", "nmr.layers"):
        return
    texts = (
        parameter_texts(nmr.render_silhouette)
        | parameter_texts(nmr.render)
        | parameter_texts(thing)
    )
    text = NumpyDocString("\n".join(lines))
    # "near, far" is one entry
    text["Parameters"] = list(
        dict.fromkeys(_hashable(texts[name]) for name in inspect.signature(thing).parameters)
    )
    lines[:] = str(text).splitlines()


def _hashable(entry: Parameter) -> Parameter:
    return entry._replace(desc=tuple(entry.desc))


def setup(app: Sphinx) -> None:
    # before numpydoc
    app.connect("autodoc-process-docstring", explain_all_parameters, priority=400)
    app.connect("source-read", show_gallery)
    app.connect("source-read", offer_colab)
    # before Sphinx collects the downloads
    app.connect("doctree-read", hand_out_files, priority=400)
