"""The page of the commands has them all, with their options."""

from __future__ import annotations

import os
import runpy
from pathlib import Path

import pytest

from adaptgns.__main__ import COMMANDS
from adaptgns.plot import SUBCOMMANDS

DOCS = Path(__file__).parents[2] / "docs"


def test_every_command_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mkdocs", reason="mkdocs is not installed: pip install '.[docs]'")
    monkeypatch.setenv("COLUMNS", "40")  # put back afterwards
    page = list(runpy.run_path(str(DOCS / "commands.py"))["page"]())
    assert os.environ["COLUMNS"] != "40"
    sections = "\n".join(page).split("\n## ")[1:]
    assert [section.split()[0] for section in sections] == list(COMMANDS)
    for section in sections:
        assert "\nusage: python -m adaptgns." in section
        assert "-h, --help" in section
    told = dict(zip(COMMANDS, sections, strict=True))
    assert "--tau FLOAT Percentile of sigma" in " ".join(told["rollout"].split())
    assert "(length per frame). (default: 0.00015)" in " ".join(told["train"].split())
    for subcommand in SUBCOMMANDS:
        assert f"\n### plot {subcommand}\n" in told["plot"]
    assert "--fps INT" in told["plot"]
    assert max(len(line) for line in told["inspect"].splitlines() if line.startswith("  ")) <= 80
