"""The report of a study: Markdown and HTML, and its tables as JSON with the files of each row."""

from __future__ import annotations

import base64
import re
from dataclasses import asdict
from pathlib import Path

from markdown import markdown

from adaptgns.atomic import replace_text, write_json
from adaptgns.reproduce import figures
from adaptgns.reproduce.profiles import PRIORS
from adaptgns.reproduce.results import Results
from adaptgns.reproduce.runs import Study, read_json, read_machines
from adaptgns.reproduce.tables import Row, Table, tables
from adaptgns.sweep import HEAT_MAP

CAPTIONS = {
    "statistics": "Graphs of the true positions, mean and standard deviation over the test set.",
    "graphs": "Figure 1: the interaction graph of an adaptive rollout, extra edges in green.",
    "sigma": "Figure 2: where the model is unsure.",
    "steps": "Figure 3: edges and errors at every step; bands reach from the lowest to the highest "
    "seed.",
    "pareto": "What the error costs, in edges and in time, with its 95 % interval; hollow: models "
    "trained for longer; line: what no other model shown undercuts, in the mean. Over the "
    "trajectories that all were rolled out over. Times of another "
    "processor are left out.",
    "reliability": "Predicted and measured errors by deciles, a line for each seed.",
    "long": "Long rollouts: the error, and edges within the data's radius, predicted over true.",
    "clouds": "Kinetic energy, and the distance between predicted and true clouds.",
}
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 64rem; margin: 2rem auto; padding: 0 1rem;
       color: #1a2230; }
table { border-collapse: collapse; font-size: 12.5px; margin: 1rem 0; display: block;
        overflow-x: auto; }
th, td { padding: 3px 9px; border-bottom: 1px solid #dde2e8; text-align: right; }
th:first-child, td:first-child, th:nth-child(2), td:nth-child(2) { text-align: left; }
img { max-width: 100%; }
"""
EXPLAINING = ("two-pass", "base-sigma", "knn", *PRIORS)
"""Policies that the README leaves to the report"""
MARKERS = ("<!-- results -->", "<!-- end of results -->")


def write(study: Study) -> list[Path]:
    """Write the report into the study's folder: report.md, report.html, tables.json and figures/.

    Raises StudyError where a run is missing or was made with another configuration; then nothing
    is written.
    """
    results = Results(study)
    made = tables(results)
    images = figures.write(results, study.out / "figures")
    text = _markdown(study, made, images)
    paths = [study.out / name for name in ("report.md", "report.html", "tables.json")]
    replace_text(paths[0], text)
    replace_text(paths[1], _html(text, study.out))
    write_json(paths[2], {"tables": [asdict(table) for table in made]})
    return paths


def write_into(study: Study, readme: Path) -> None:
    """Replace what lies between the two marks in ``readme`` by the tables of the rollouts, of the
    prominent models, without the policies that are there to explain others."""
    text = readme.read_text("utf-8")
    start, end = (text.find(marker) for marker in MARKERS)
    if start < 0 or end < start:
        raise ValueError(f"{readme}: holds no {MARKERS[0]} followed by {MARKERS[1]}")
    parts = [_made(study)]
    left_out = {model.title for model in study.profile.models if not model.prominent}
    for table in tables(Results(study)):
        if table.name.startswith("rollouts"):
            kept = [
                0,
                1,
                *range(2, 4 + len(study.profile.marks)),
                -3,
            ]  # the columns that say it; the report has them all
            rows = [
                Row([row.cells[i] for i in kept])
                for row in table.rows
                if row.cells[0] not in left_out and row.cells[1] not in EXPLAINING
            ]
            short = Table(table.name, table.title, [table.columns[i] for i in kept], rows)
            parts.append(f"**{table.title}**\n\n{_table(short)}")
    inside = "\n\n".join(parts)
    replace_text(readme, text[: start + len(MARKERS[0])] + f"\n{inside}\n" + text[end:])


def _markdown(study: Study, made: list[Table], images: list[Path]) -> str:
    parts = [f"# The paper's tables and figures, profile {study.preset}", _made(study)]
    for data in study.sets.values():
        if study.profile.gate is not None:
            gate = read_json(data.metrics / "gate.json")
            tried = ", ".join(f"{r:.2f} after {int(s):,}" for s, r in gate["ratios"].items())
            parts.append(
                f"Gate on {data.name}: edges on predicted over true positions of the fixed MSE "
                f"baseline, validation, step {study.last_mark}: {tried} steps; wanted at most "
                f"{gate['wanted']}. All models trained {gate['steps']:,} steps."
            )
    for table in made:
        parts += [f"## {table.title}", _table(table)]
        if table.note:
            parts.append(table.note)
    parts.append("## Figures")
    for data in study.sets.values():
        for model in study.profile.models_on(data.source):
            if model.chosen is None:
                continue
            folder = data.metrics / model.chosen.folder
            heat_map = (folder / f"{HEAT_MAP}.png").relative_to(study.out).as_posix()
            parts.append(
                f"![{model.chosen.folder}]({heat_map})\n\n{model.title} on "
                f"{data.name}, validation: error and, below it, edges a step."
            )
    for path in images:
        relative = path.relative_to(study.out).as_posix()
        parts.append(f"![{path.stem}]({relative})\n\n{CAPTIONS[path.stem]}")
    parts.append(
        "Every number comes from the files in `metrics/` that `tables.json` names for its row."
    )
    return "\n\n".join(parts) + "\n"


def _made(study: Study) -> str:
    """When, where and at what size."""
    machines = [
        f"on {machine['date']} on {machine['processor']}, {machine['cores']} cores, torch "
        f"{machine['torch']}"
        for machine in read_machines(study.out)
    ]
    profile = study.profile
    count = "all" if profile.trajectories is None else f"the first {profile.trajectories}"
    gate = "" if profile.gate else " No gate: the ratios tell how far the models clump."
    return (
        f"Made with `python -m adaptgns.reproduce --preset {study.preset}` "
        f"{', and '.join(machines)}. "
        f"{len(profile.seeds)} seeds, {profile.base.steps:,} training steps, {count} test "
        f"trajectories, unless a row says otherwise.{gate}"
    )


def _table(table: Table) -> str:
    lines = [" | ".join(table.columns), " | ".join("---" for _ in table.columns)]
    lines += [" | ".join(cell.replace("|", "\\|") for cell in row.cells) for row in table.rows]
    lines[0] = lines[0].replace("|Δ|", "\\|Δ\\|")
    return "\n".join(f"| {line} |" for line in lines)


def _html(text: str, folder: Path) -> str:
    """A page that needs no other file."""
    body = markdown(text, extensions=["tables"])

    def embedded(match: re.Match[str]) -> str:
        data = base64.b64encode((folder / match[1]).read_bytes()).decode()
        return f'src="data:image/png;base64,{data}"'

    body = re.sub(r'src="([^"]+\.png)"', embedded, body)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>AdaptGNS: results'
        f"</title><style>{STYLE}</style></head>\n<body>\n{body}\n</body></html>\n"
    )
