"""All of benchmarks/results as tables and pictures: a new folder or file there appears by itself."""

import csv
import json
from pathlib import Path
from typing import Any

from benchmarks.plot import plot
from benchmarks.published import COLUMNS, learning
from generate.markdown import table

Row = dict[str, Any]
FOLDED = 12
"""Rows from which on a table is folded up."""


def all_results(results: Path, pictures: Path) -> str:
    """Returns a section for each folder of results, newest first; paths are relative to docs/.

    Args:
        results: the folder benchmarks/results.
        pictures: a folder below docs/, into which the pictures of training runs are drawn.
    """
    folders = sorted((path for path in results.iterdir() if path.is_dir()), reverse=True)
    return "\n".join(_folder(folder, results.parent.parent, pictures) for folder in folders)


def _folder(folder: Path, root: Path, pictures: Path) -> str:
    date, device = folder.name[:10], folder.name[11:]
    parts = [f"## {device}, {date}\n"]
    trained = sorted(path.parent for path in folder.rglob("about.json"))
    parts += [_runs(path, root, pictures / f"{folder.name}-{path.name}.png") for path in trained]
    for path in sorted(path for path in folder.rglob("*") if path.parent not in trained):
        link = f"../{path.relative_to(root).as_posix()}"
        heading = f"### {path.relative_to(folder).with_suffix('').as_posix().replace('/', ', ')}\n"
        if path.suffix == ".json":
            parts += [heading, _json(json.loads(path.read_text()), link)]
        elif path.suffix == ".csv":
            rows = list(csv.DictReader(path.read_text().splitlines()))
            parts += [heading, _rows([{key: _number(value) for key, value in row.items()} for row in rows])]
            parts.append(f"From [{path.name}]({link}).\n")
        elif path.suffix == ".png":
            parts.append(f"![{path.stem}]({link})\n")
        elif path.suffix == ".txt":
            parts += [heading, f"[{path.name}]({link})\n"]
    return "\n".join(parts)


def _runs(folder: Path, root: Path, picture: Path) -> str:
    """Returns table and picture of a folder of training runs, and draws the picture."""
    calls = json.loads((folder / "about.json").read_text())
    picture.parent.mkdir(parents=True, exist_ok=True)
    plot(folder, picture)
    lines = (
        ["" if row[name] is None else f"{row[name]:{spec}}" for name, spec in COLUMNS.items()]
        for row in learning(folder)
    )
    files = sorted(path for path in folder.iterdir() if path.is_file())
    links = ", ".join(f"[{path.name}](../{path.relative_to(root).as_posix()})" for path in files)
    how = "".join(f"`{call['command']}`: {call['devices']} x {call['device']}, {call['date']}\n\n" for call in calls)
    notes = "".join(f"{note}\n\n" for note in dict.fromkeys(call["note"] for call in calls if "note" in call))
    return (
        f"### {folder.name}\n\nThe best policy of each seed in new episodes, beside published returns:\n\n"
        f"{notes}{table(tuple(COLUMNS), lines)}\n"
        f"![Return against training time]({picture.relative_to(root / 'docs').as_posix()})\n\n"
        f"{how}All numbers: {links}.\n"
    )


def _json(results: dict[str, Any], link: str) -> str:
    versions = ", ".join(f"{name} {version}" for name, version in results["versions"].items())
    how = (
        f"`{results['command']}` on {results['device']}, {results['date']}, revision `{results['revision'][:9]}`, "
        f"with {versions} ([all digits]({link})).\n"
    )
    rows = results["rows"]
    by_worlds = {"body", "worlds", "case", "ms"}
    if rows and by_worlds <= rows[0].keys() and len({row["worlds"] for row in rows}) > 1:
        return f"{how}\nMilliseconds for a control step of all worlds:\n\n{_pivot(rows)}\n{_rows(rows, fold=1)}"
    return f"{how}\n{_rows(rows)}"


def _pivot(rows: list[Row]) -> str:
    """Returns a table with a line for each body and case and a column for each number of worlds."""
    worlds = sorted({row["worlds"] for row in rows})
    times: dict[tuple[str, str], Row] = {}
    for row in rows:
        times.setdefault((row["body"], row["case"]), {})[row["worlds"]] = row["ms"]
    lines = [(*key, *(_text(cells.get(n)) for n in worlds)) for key, cells in times.items()]
    return table(("body", "case", *(f"{n} worlds" for n in worlds)), lines)


def _rows(rows: list[Row], fold: int = FOLDED) -> str:
    """Returns rows as they are, folded up if they are many."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    text = table(columns, ([_text(row.get(column)) for column in columns] for row in rows))
    if len(rows) < fold:
        return text
    return f"<details><summary>All {len(rows)} rows</summary>\n\n{text}\n</details>\n"


def _text(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _number(text: str) -> int | float | str:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
