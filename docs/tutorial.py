"""Makes the page of the tutorial from its notebook whenever mkdocs builds the site."""

from __future__ import annotations

from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from nbconvert import MarkdownExporter


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Called by mkdocs: adds `tutorial.md` and the pictures among its outputs to the site."""
    page, resources = MarkdownExporter().from_filename(str(Path(__file__).with_suffix(".ipynb")))
    files.append(File.generated(config, "tutorial.md", content=page))
    for name, picture in resources["outputs"].items():
        files.append(File.generated(config, name, content=picture))
    return files
