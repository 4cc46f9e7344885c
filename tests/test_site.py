"""The site builds without a warning, its links lead somewhere, and a page asks no other server for anything."""

import inspect
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import nmr

pytest.importorskip("sphinx", reason='needs the extra "site"')
pytest.importorskip("myst_nb", reason='needs the extra "site"')
pytest.importorskip("sphinx_copybutton", reason='needs the extra "site"')

DOCS = Path(__file__).parent.parent / "docs"


class Page(HTMLParser):
    """What a page links to, what it loads, and the names of its places."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links, self.loads, self.places = [], [], set()
        self.feed(path.read_text())

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.places |= {attributes[name] for name in ("id", "name") if attributes.get(name)}
        if tag == "a" and attributes.get("href"):
            self.links.append(attributes["href"])
        if tag in ("script", "img", "iframe", "source", "link") and attributes.get("rel") not in (
            "next",
            "prev",
        ):
            self.loads += [attributes[name] for name in ("src", "href") if attributes.get(name)]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the built site. In a folder of its own, so that the installed package is described."""
    folder = tmp_path_factory.mktemp("site")
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "--fail-on-warning",
        "--keep-going",
        "--quiet",
        DOCS,
        folder / "html",
    ]
    environment = os.environ | {"GITHUB_REPOSITORY": "somebody/nmr"}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder / "html"


@pytest.fixture(scope="module")
def pages(site):
    return {path: Page(path) for path in site.rglob("*.html")}


def test_every_page_of_the_docs_is_there(site):
    sources = [*DOCS.rglob("*.md"), *DOCS.rglob("*.rst"), *DOCS.rglob("*.ipynb")]
    for page in set(sources) - set((DOCS / "log").iterdir()):  # logs are downloads
        shown = "index.html" if page == DOCS / "examples" / "README.md" else page.relative_to(DOCS)
        assert (site / shown).with_suffix(".html").exists()


def test_links_lead_to_places_that_exist(pages):
    lost = []
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            place = unquote(parts.fragment)
            if not target.is_file() or (
                place and target in pages and place not in pages[target].places
            ):
                lost.append((path.name, link))
    assert lost == []


def test_pages_load_nothing_from_elsewhere(site, pages):
    loads = [(path.name, load) for path, page in pages.items() for load in page.loads]
    assert len(loads) > 100
    assert [(name, load) for name, load in loads if urlsplit(load).netloc] == []
    for sheet in site.rglob("*.css"):
        assert not re.findall(r"(?:url\(|@import)\s*['\"]?(?:https?:)?//", sheet.read_text()), (
            sheet.name
        )


def test_links_show_words_and_no_markup(site):
    for path in site.glob("*.html"):
        assert "&lt;inline" not in path.read_text(), path.name


def test_every_public_name_is_described(pages):
    described = set().union(*(page.places for page in pages.values()))
    public = {f"nmr.{name}" for name in nmr.__all__} - {"nmr.cameras", "nmr.losses", "nmr.metrics"}
    for module in (nmr.cameras, nmr.losses, nmr.metrics):
        public |= {
            f"{module.__name__}.{name}" for name in module.__all__ if name not in nmr.__all__
        }
    assert sorted(public - described) == []


def test_every_parameter_of_a_drawing_function_is_explained_at_it(site):
    page = (site / "api" / "rendering.html").read_text()
    for name in [name for name in nmr.__all__ if name.startswith("render")]:
        section = page[page.index(f'id="nmr.{name}"') :].partition("</section>")[0]
        section = section[section.index('<dl class="field-list') :]  # after the signature
        for parameter in inspect.signature(getattr(nmr, name)).parameters:
            assert re.search(rf"<strong>[^<]*\b{parameter}\b", section), (name, parameter)


def test_notebooks_lead_to_colab(site):
    for notebook in (DOCS / "examples").glob("*.ipynb"):
        page = (site / "examples" / f"{notebook.stem}.html").read_text()
        assert (
            f"colab.research.google.com/github/somebody/nmr/blob/main/docs/examples/{notebook.name}"
            in page
        )
