"""Results of the benchmarks, on the terminal and as JSON."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from hm_sfm.io.atomic import replace_file

TEXT_COLUMNS = 2
"""The first columns of a table, scene and method, are words."""


def format_table(rows: Sequence[Mapping[str, object]]) -> str:
    """Rows of the same keys as a table of text: keys as header, numbers with two digits, None as '-'."""

    def show(value: object) -> str:
        return "-" if value is None else f"{value:.2f}" if isinstance(value, float) else str(value)

    cells = [list(rows[0]), *([show(value) for value in row.values()] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells)]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if at < TEXT_COLUMNS else cell.rjust(width)
            for at, (cell, width) in enumerate(zip(line, widths))
        ).rstrip()
        for line in cells
    )


def format_markdown(rows: Mapping[str, Mapping[str, float]], columns: Sequence[str]) -> str:
    """Scores by row and column as a table of Markdown, with one digit; columns that no row has are left out."""
    known = [name for name in columns if any(name in scores for scores in rows.values())]
    cells = [["", *known], *([row, *(f"{scores[name]:.1f}" for name in known)] for row, scores in rows.items())]
    widths = [max(3, *map(len, column)) for column in zip(*cells)]
    cells.insert(1, ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])])
    lines = ([line[0].ljust(widths[0]), *map(str.rjust, line[1:], widths[1:])] for line in cells)
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def write_json(path: Path, content: object) -> None:
    """Write a JSON file, atomically."""
    with replace_file(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n")
