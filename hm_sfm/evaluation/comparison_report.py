"""A comparison for people to read: a table for the terminal, OUT/compare.json, and the plots of OUT/compare.png."""

import dataclasses
from importlib.metadata import version
from pathlib import Path

import numpy as np

from hm_sfm.errors import MissingPackageError
from hm_sfm.evaluation.compared_methods import AUC_SHOWN_DEG, MethodResult
from hm_sfm.evaluation.comparison import Comparison
from hm_sfm.io.atomic import replace_file, write_json
from hm_sfm.io.pictures import DRAWN_BY_US

STAGES = ("match", "keypoints", "verify", "map")
LINE_STYLES = ("-", "--", ":", "-.")
COLOURS = 10
"""In matplotlib's default cycle."""


def require_plots() -> None:
    """Raises MissingPackageError where matplotlib is not installed: better before hours of matching than after."""
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError as error:
        raise MissingPackageError(
            "the plots of a comparison need the package matplotlib, which is not installed: pip install matplotlib"
        ) from error


def format_table(comparison: Comparison) -> str:
    """The metrics of all methods, one method a line, under a line of headings.

    `matched` is the mean length of tracks as matched and verified, `track` and `median` are of the points, `per image`
    counts observations, `px` is the reprojection error.
    """
    headings = ["method", "images", "models", "matched", "points", ">= 3 images", "track", "median", "per image", "px"]
    if comparison.methods[0].auc_percent is not None:
        headings += [f"AUC@{limit:g}" for limit in AUC_SHOWN_DEG]
    headings += [f"{stage} s" for stage in STAGES]
    rows = [headings] + [format_row(method) for method in comparison.methods]
    widths = [max(len(row[column]) for row in rows) for column in range(len(headings))]
    lines = []
    for name, *cells in rows:
        padded = [cell.rjust(width) for cell, width in zip(cells, widths[1:])]
        lines.append("  ".join([name.ljust(widths[0]), *padded]))
    return "\n".join(lines)


def format_row(method: MethodResult) -> list[str]:
    """The cells of a method."""
    cells = [
        method.name,
        str(method.registered),
        str(method.models),
        f"{method.mean_matched_track_length:.2f}",
        str(method.points),
        str(method.points_in_3_images),
        f"{method.mean_track_length:.2f}",
        f"{method.median_track_length:g}",
        f"{method.observations_per_image:.0f}",
        f"{method.mean_reprojection_px:.3f}",
    ]
    if method.auc_percent is not None:
        cells += [f"{method.auc_percent[limit]:.1f}" for limit in AUC_SHOWN_DEG]
    seconds = [method.seconds[stage] for stage in STAGES]
    return cells + ["-" if spent is None else f"{spent:.0f}" for spent in seconds]


def write_comparison(path: Path, comparison: Comparison) -> None:
    """Write everything that a comparison holds, the methods by their names, and the version as JSON; atomic."""
    content = dataclasses.asdict(comparison)
    content["methods"] = {method.pop("name"): method for method in content["methods"]}
    write_json(path, content | {"version": version("hm_sfm")})


def plot_tracks(path: Path, comparison: Comparison) -> None:
    """Write a PNG: how many points have each track length, and which share of the points is seen in n images or more.

    Raises MissingPackageError without matplotlib.
    """
    require_plots()
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(13, 5), layout="constrained")
    counts, shares = figure.subplots(1, 2)
    for number, method in enumerate(comparison.methods):
        length, points = lay_out_histogram(method.track_length_histogram)
        style = {"color": f"C{number % COLOURS}", "linestyle": LINE_STYLES[number // COLOURS % len(LINE_STYLES)]}
        label = f"{method.name} (mean {method.mean_track_length:.2f})"
        counts.plot(length, np.where(points > 0, points, np.nan), marker="o", markersize=3, label=label, **style)
        surviving = points[::-1].cumsum()[::-1]
        shares.plot(length, 100 * surviving / max(1, surviving[0]), marker="o", markersize=3, **style)
    counts.set(title="Track lengths", xlabel="images that see a point", ylabel="points", yscale="log")
    shares.set(title="Survival", xlabel="n", ylabel="points seen in n images or more, %", ylim=(0, 102))
    for axes in (counts, shares):
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.grid(alpha=0.3)
    figure.legend(loc="outside right upper", fontsize="small")
    with replace_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=120, pil_kwargs={"exif": DRAWN_BY_US})


def lay_out_histogram(histogram: dict[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """{length: points} -> lengths 2, 3, ... up to the longest (N,) and the points of each (N,), 0 where none."""
    length = np.arange(2, max(histogram, default=2) + 1)
    return length, np.array([histogram.get(int(n), 0) for n in length])
