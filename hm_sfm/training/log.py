"""The rows of log.csv and validation.csv."""

import csv
from pathlib import Path

from hm_sfm.io.atomic import replace_file


def drop_rows_after(path: Path, step: int) -> None:
    """Remove the rows of a CSV file that an interrupted run logged after its last checkpoint; atomic."""
    if not path.exists():
        return
    header, *rows = path.read_text().splitlines(keepends=True) or [""]
    # The last row may be cut short where the machine went down.
    whole = [row for row in rows if row.endswith("\n") and row.count(",") == header.count(",")]
    kept = [header] + [row for row in whole if int(row.split(",")[0]) <= step]
    with replace_file(path) as temporary:
        temporary.write_text("".join(kept))


def append_row(path: Path, row: dict) -> None:
    """Append a row to a CSV file, with the header where the file is new or empty."""
    new = not path.exists() or not path.stat().st_size
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, row)
        if new:
            writer.writeheader()
        writer.writerow({key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()})
