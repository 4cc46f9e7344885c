"""Settings of the site, which `bash tools/site.sh` builds with Sphinx."""

import contextlib
import inspect
import io
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
from learn3d.commands import COMMANDS, main

project = "nmr + learn3d"
author = "the authors of nmr and learn3d"
release = nmr.__version__
html_title = f"nmr + learn3d {release}"

#: OWNER/NAME on GitHub, which names it to its own builds; elsewhere the site has no links to the repository.
repository = os.environ.get("GITHUB_REPOSITORY")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.intersphinx",
    "numpydoc",
    "sphinx_copybutton",
]
# read from the internet, so not in a build without it
intersphinx_mapping = (
    {
        "python": ("https://docs.python.org/3", None),
        "torch": ("https://docs.pytorch.org/docs/stable", None),
        "numpy": ("https://numpy.org/doc/stable", None),
    }
    if os.environ.get("GITHUB_ACTIONS")
    else {}
)
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
if repository:
    html_theme_options = {
        "source_repository": f"https://github.com/{repository}",
        "source_branch": "main",
        "source_directory": "docs/",
    }


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


def show_commands(app: Sphinx, page: str, text: list[str]) -> None:
    """Put the help of each command on the page of commands."""
    if page == "commands":
        blocks = []
        for name, (_, _, purpose) in COMMANDS.items():
            printed = io.StringIO()
            with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
                main(name, "--help")
            blocks.append(f"## {name}\n\nTo {purpose}.\n\n```text\n{printed.getvalue()}```\n")
        text[0] = text[0].replace("<!-- help of all commands -->", "\n".join(blocks))


def show_names(app: Sphinx, page: str, text: list[str]) -> None:
    """Put a table of all public names of nmr on its page."""
    if page == "api/nmr":
        names = "\n".join(
            f"   nmr.{name}" for name in nmr.__all__ if not inspect.ismodule(getattr(nmr, name))
        )
        text[0] += f"\n.. autosummary::\n\n{names}\n"


def link_sources(app: Sphinx, doctree: nodes.document) -> None:
    """Links to files that are no pages lead to the repository; without one they are text, not downloads."""
    folder = Path(app.env.doc2path(app.env.docname)).parent
    for link in list(doctree.findall(addnodes.download_reference)):
        _link(link, folder / link["reftarget"])
    for link in list(doctree.findall(addnodes.pending_xref)):
        # a Markdown file; outside of docs, the target is absolute
        target = Path(app.srcdir) / f"{link['reftarget']}.md"
        if (
            link.get("refdomain") == "doc"
            and link["reftarget"] not in app.env.found_docs
            and target.is_file()
        ):
            _link(link, target)


def _link(link: nodes.Element, file: Path) -> None:
    path = file.resolve().relative_to(Path(__file__).resolve().parent.parent).as_posix()
    if repository:
        address = f"https://github.com/{repository}/blob/main/{path}"
        link.replace_self(nodes.reference("", "", *link.children, refuri=address))
    else:
        link.replace_self(nodes.inline("", "", *link.children))


def parameter_texts(function: Any) -> dict[str, Parameter]:
    """The texts of a function's parameters by name, without those that refer to another function."""
    entries = [
        entry
        for entry in FunctionDoc(function)["Parameters"]
        if entry.desc and not re.fullmatch(r"As in :func:`\w+`\.", entry.desc[0])
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
    app.connect("source-read", show_commands)
    app.connect("source-read", show_names)
    # before Sphinx collects the downloads
    app.connect("doctree-read", link_sources, priority=400)
