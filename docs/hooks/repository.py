"""Links of the pages that leave docs/: the site has a page for each file of the repository that they name.

A Markdown file and a notebook become pages, code and configurations are shown as text, other files are copied. So one
link serves a reader on the site, in an editor and on a forge, and the site needs no server.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path

import nbformat
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page
from nbconvert import MarkdownExporter

ROOT = Path(__file__).resolve().parents[2]
FOLDER = "repository"  # of the pages on files outside of docs/
LINK = re.compile(r"(!?\[[^\]]*\])\(([^)\s]+)\)")
FENCE = re.compile(r"(^```.*?^```$)", re.MULTILINE | re.DOTALL)
COPIED = {".png", ".webp", ".gif", ".mp4", ".svg"}
LANGUAGES = {".py": "python", ".yaml": "yaml", ".sh": "bash", ".toml": "toml", ".json": "json", ".cff": "yaml"}
LONGEST = 100_000  # characters of a file that is shown

_origins: dict[str, str] = {}  # page of the site -> path of its text in the repository


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for each file that a page links to, and for those that these link to."""
    _origins.clear()
    waiting = [file.src_uri for file in files if file.is_documentation_page()]
    _origins.update({page: f"docs/{page}" for page in waiting})
    texts = {file.src_uri: file.content_string for file in files if file.is_documentation_page()}
    while waiting:
        page = waiting.pop()
        for target in _outside(texts[page], _origins[page]):
            uri = page_of(target)
            if uri in texts:
                continue
            texts[uri] = ""
            file = _generated(target, uri, config, files)
            files.append(file)
            if file.is_documentation_page():
                _origins[uri] = target
                texts[uri] = "" if _is_code(target) else file.content_string
                waiting.append(uri)
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """The text of a page with its links as the site needs them."""
    here = page.file.src_uri
    origin = _origins.get(here, f"docs/{here}")

    def mended(match: re.Match[str]) -> str:
        target, anchor = _target(match[2], origin)
        if target is None or (_in_site(target) and origin.startswith("docs/")):
            return match[0]
        path = posixpath.relpath(page_of(target), posixpath.dirname(here) or ".")
        return f"{match[1]}({path}{anchor})"

    return "".join(part if part.startswith("```") else LINK.sub(mended, part) for part in FENCE.split(markdown))


def page_of(target: str) -> str:
    """Path in the site of a file or folder of the repository."""
    if _in_site(target):
        return target.removeprefix("docs/")
    path = ROOT / target
    if path.is_dir():
        return f"{FOLDER}/{target}/index.md"
    if path.suffix == ".ipynb":
        return f"{FOLDER}/{target.removesuffix('.ipynb')}.md"
    return f"{FOLDER}/{target}.md" if _is_code(target) else f"{FOLDER}/{target}"


def _in_site(target: str) -> bool:
    """Whether a path is a page or another file of docs/, which the site has anyway."""
    return target.startswith("docs/") and not (ROOT / target).is_dir()


def _is_code(target: str) -> bool:
    """Whether a file is shown as text."""
    path = ROOT / target
    return path.is_file() and path.suffix not in {".md", ".ipynb", *COPIED}


def _target(link: str, origin: str) -> tuple[str | None, str]:
    """Path in the repository that a link of the file ``origin`` names, and its anchor; None: elsewhere."""
    path, _, anchor = link.partition("#")
    if "://" in link or link.startswith("mailto:") or not path or path.startswith("data:"):
        return None, ""
    target = posixpath.normpath(posixpath.join(posixpath.dirname(origin), path))
    if (ROOT / target / "README.md").is_file():
        target = f"{target}/README.md".removeprefix("./")
    return (target if (ROOT / target).exists() else None), f"#{anchor}" if anchor else ""


def _outside(text: str, origin: str) -> list[str]:
    """Files of the repository outside of docs/ that a text links to."""
    prose = "".join(part for part in FENCE.split(text) if not part.startswith("```"))
    targets = (_target(match[2], origin)[0] for match in LINK.finditer(prose))
    return [target for target in targets if target and not _in_site(target)]


def _generated(target: str, uri: str, config: MkDocsConfig, files: Files) -> File:
    path = ROOT / target
    if path.is_dir():
        text = _listing(path, target)
    elif path.suffix == ".ipynb":
        text = _notebook(path, uri, config, files)
    elif path.suffix == ".md":
        text = path.read_text(encoding="utf-8")
    elif path.suffix in COPIED:
        return File.generated(config, uri, abs_src_path=str(path), inclusion=InclusionLevel.NOT_IN_NAV)
    else:
        text = _shown(path, target)
    return File.generated(config, uri, content=text, inclusion=InclusionLevel.NOT_IN_NAV)


def _shown(path: Path, target: str) -> str:
    """A page with the text of a file, which the search leaves out."""
    text = path.read_text(encoding="utf-8")[:LONGEST]
    language = LANGUAGES.get(path.suffix, "text")
    return f"---\nsearch:\n  exclude: true\n---\n# {target}\n\n````{language}\n{text.rstrip()}\n````\n"


def _listing(path: Path, target: str) -> str:
    names = sorted(part.name for part in path.iterdir() if not part.name.startswith((".", "__")))
    return f"# {target}\n\n" + "\n".join(f"- `{name}`" for name in names) + "\n"


def _notebook(path: Path, uri: str, config: MkDocsConfig, files: Files) -> str:
    """A notebook as a page, with the outputs that are stored in it."""
    text, resources = MarkdownExporter().from_notebook_node(nbformat.read(path, as_version=4))
    folder = posixpath.dirname(uri)
    for name, content in resources["outputs"].items():
        own = f"{path.stem}_{name}"
        text = text.replace(f"({name})", f"({own})")
        files.append(File.generated(config, f"{folder}/{own}", content=content, inclusion=InclusionLevel.NOT_IN_NAV))
    return text
