"""Results of the benchmarks, on the terminal."""

from collections.abc import Mapping, Sequence

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
