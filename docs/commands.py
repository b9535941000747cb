"""Makes the page of the commands whenever mkdocs builds the site: what `--help` of each prints."""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout, suppress
from io import StringIO

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from adaptgns.__main__ import COMMANDS

COLUMNS = "80"
"""Characters of a line that the page has room for"""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Called by mkdocs: adds `commands.md` to the site."""
    files.append(File.generated(config, "commands.md", content="\n\n".join(page())))
    return files


def page() -> Iterator[str]:
    """The paragraphs of the page, in Markdown."""
    os.environ["COLUMNS"] = COLUMNS
    yield "# Commands"
    yield (
        "Each is a module, `python -m adaptgns.NAME`, and a subcommand, `adaptgns NAME`. This page "
        "is what their `--help` tells: every option with its unit and its default."
    )
    for name in COMMANDS:
        module = importlib.import_module(f"adaptgns.{name}")
        yield f"## {name}"
        yield from told(module.main, [])
        for subcommand in getattr(module, "SUBCOMMANDS", ()):
            yield f"### {name} {subcommand}"
            yield from told(module.main, [subcommand])


def told(main: Callable[[list[str]], None], arguments: list[str]) -> Iterator[str]:
    """What a command says of itself, as prose, then its options as they are printed."""
    with redirect_stdout(StringIO()) as printed, suppress(SystemExit):
        main([*arguments, "--help"])
    # Lines within the options are never empty, but end in blanks.
    usage, *prose, options = printed.getvalue().strip().split("\n\n")
    yield from prose
    lines = "\n".join(line.rstrip() for line in options.splitlines())
    yield f"```text\n{usage}\n\n{lines}\n```"
