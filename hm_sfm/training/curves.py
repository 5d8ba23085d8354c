"""The curves of a training: log.csv and validation.csv as a picture."""

import csv
from pathlib import Path

import numpy as np

from hm_sfm.errors import MissingPackageError
from hm_sfm.io.atomic import replace_file
from hm_sfm.io.pictures import DRAWN_BY_US

SMOOTHED_SHARE = 0.02
"""Of the steps that each point of a loss curve is the mean of."""
UNPLOTTED = ("step", "rate", "gradient", "seconds")
"""Columns of log.csv that are no loss."""
COLUMNS = 3


def draw_curves(log: Path, validation: Path, path: Path) -> None:
    """Write a PNG of the parts of the loss, smoothed, the learning rate, and each score of the validation; atomic.

    Scores such as right@0.2 and right@0.4 share a panel. validation may not exist yet. Raises MissingPackageError
    without matplotlib.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingPackageError(
            f"{path} is not drawn: it needs the package matplotlib, pip install matplotlib"
        ) from error
    logged = read_columns(log)
    scores = read_columns(validation) if validation.exists() else {"step": np.zeros(0)}
    panels: dict[str, list[str]] = {}
    for name in scores:
        if name != "step":
            panels.setdefault(name.partition("@")[0], []).append(name)
    rows = -(-(2 + len(panels)) // COLUMNS)
    figure = Figure(figsize=(5 * COLUMNS, 3.2 * rows), layout="constrained")
    axes = figure.subplots(rows, COLUMNS, squeeze=False).flatten()
    for name in logged:
        if name not in UNPLOTTED:
            axes[0].plot(*smooth(logged["step"], logged[name]), label=name)
    axes[0].legend(fontsize="small")
    axes[0].set_title("loss and its parts")
    axes[1].plot(logged["step"], logged["rate"])
    axes[1].set_title("learning rate")
    for panel, (title, names) in zip(axes[2:], panels.items()):
        for name in names:
            panel.plot(scores["step"], scores[name], marker="o", markersize=3, label=name)
        panel.set_title(f"held-out pairs: {title}")
        if len(names) > 1:
            panel.legend(fontsize="small")
    for panel in axes[: 2 + len(panels)]:
        panel.set_xlabel("step")
        panel.grid(alpha=0.3)
    for panel in axes[2 + len(panels) :]:
        panel.remove()
    with replace_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=100, pil_kwargs={"exif": DRAWN_BY_US})


def read_columns(path: Path) -> dict[str, np.ndarray]:
    """The columns of a CSV file of numbers, (N,) float64 each, by their names."""
    with path.open(newline="") as file:
        names, *rows = csv.reader(file)
    values = np.array(rows, dtype=np.float64).reshape(-1, len(names))
    return dict(zip(names, values.T))


def smooth(step: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Running means of both (N,) over SMOOTHED_SHARE of them, (M,) each; M > 0 where N is."""
    width = max(1, round(SMOOTHED_SHARE * len(value)))
    kernel = np.full(width, 1 / width)
    mean_step, mean_value = (np.convolve(x, kernel, mode="valid") if len(x) else x for x in (step, value))
    return mean_step, mean_value
