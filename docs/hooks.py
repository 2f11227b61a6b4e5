"""
Hooks for MkDocs: files beside docs/ that the pages link, equations without JavaScript, docstrings' roles.

The site holds docs/ at its root, and each linked file beside it under its own path; of a linked folder, its README.
"""

import html
import posixpath
import re
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
LINK = re.compile(r"(?<=\]\()([^)#\s:]+)(?=[)#])")
EQUATION = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
# A link of a docstring, in Sphinx's syntax.
ROLE = re.compile(r":(?:class|func|meth):<code>(~?)([\w.]+)</code>")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what the pages link, and what those link."""
    pages = [file.src_uri for file in files.documentation_pages()] + ["SECURITY.md", "CONTRIBUTING.md", "CHANGELOG.md"]
    while pages:
        page = pages.pop()
        if files.get_file_from_path(page) is None:
            files.append(File.generated(config, page, abs_src_path=str(ROOT / page)))
        if page.endswith(".md"):
            source = _source(page)
            linked = {_linked(source, link) for link in LINK.findall((ROOT / source).read_text())}
            pages += [page for page in linked if (ROOT / _source(page)).is_file() and files.get_file_from_path(page) is None]
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links between files of the repository become links between pages of the site."""
    source = _source(page.file.src_uri)
    folder = posixpath.dirname(page.file.src_uri)
    return LINK.sub(lambda link: posixpath.relpath(_linked(source, link[1]), folder or "."), markdown)


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """LaTeX becomes MathML, which browsers show; roles become links, where the page they name is there."""

    def math(equation: re.Match[str]) -> str:
        display = "block" if equation[1] == "div" else "inline"
        return convert(html.unescape(equation[2]), display=display)

    def link(role: re.Match[str]) -> str:
        name = role[2].rpartition(".")[2] if role[1] else role[2]
        return f'<autoref optional identifier="{role[2]}"><code>{name}</code></autoref>'

    return ROLE.sub(link, EQUATION.sub(math, content))


def _source(page: str) -> str:
    """Return where a page of the site lies in the repository."""
    inside = f"docs/{page}"
    return inside if (ROOT / inside).is_file() else page


def _linked(source: str, link: str) -> str:
    """The page of the site that a link leads to which stands in a file of the repository."""
    target = posixpath.normpath(posixpath.join(posixpath.dirname(source), link))
    if (ROOT / target).is_dir():
        target += "/README.md"
    return "index.md" if target == "README.md" else target.removeprefix("docs/")
