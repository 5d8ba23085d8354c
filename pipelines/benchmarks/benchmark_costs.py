"""What matching costs: milliseconds per stage, pairs per minute and peak memory, of hm_sfm and of others.

    python pipelines/benchmarks/benchmark_costs.py PHOTOS --sizes 1024 2048 --configs configs/light.yaml fast.yaml
    python pipelines/benchmarks/benchmark_costs.py PHOTOS --scaling 1000 --out out/scaling

The first form matches all pairs of the first few photos, each method and size in a process of its own. ALIKED +
LightGlue and XFeat* are measured where they are installed, see peers.py. The second form matches growing numbers of
small images, up to 1000 here: crops of the photos, rotated and scaled. It writes OUT/scaling.json and OUT/scaling.png:
time and peak memory over the number of images.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from matching_costs import METHODS, draw_scaling, measure_in_process, write_crops
from tables import format_table

from hm_sfm.errors import HmSfmError
from hm_sfm.io.atomic import write_json


def benchmark(
    photos: Path, sizes: Sequence[int], configs: Sequence[Path | None], methods: Sequence[str], count: int,
    settings: Sequence[str],
) -> list[dict[str, object]]:  # fmt: skip
    """One row per method, configuration and size; methods that are not installed have none."""
    rows = []
    for size_px in sizes:
        for method in methods:
            for config in configs if method == "hm_sfm" else [None]:
                own = settings if method == "hm_sfm" else []
                job = {"method": method, "photos": photos, "count": count, "config": config}
                rows.append(measure_in_process(job | {"settings": [*own, f"images.long_edge_px={size_px}"]}))
    return [row for row in rows if row]


def benchmark_scaling(
    photos: Path, out: Path, largest: int, config: Path | None, settings: Sequence[str]
) -> list[dict[str, object]]:
    """One row per number of images, which doubles from row to row up to `largest`; writes the curve to OUT."""
    counts = sorted({max(2, largest >> halvings) for halvings in range(5)})
    rows = []
    for count in counts:
        folder = out / f"{count}_images"
        write_crops(photos, folder / "images", count)
        job = {"method": "scaling", "photos": folder / "images", "out": folder / "matches"}
        rows.append(measure_in_process(job | {"config": config, "settings": list(settings)}))
    write_json(out / "scaling.json", rows)
    draw_scaling(out / "scaling.png", rows)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", metavar="PHOTOS", type=Path, help="a folder of photos")
    parser.add_argument("--sizes", type=int, nargs="+", default=[1024], metavar="PX", help="long edges (default: 1024)")
    text = "configurations of hm_sfm (default: its own)"
    parser.add_argument("--configs", type=Path, nargs="+", default=[None], metavar="FILE", help=text)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="default: all")
    parser.add_argument("--count", type=int, default=5, metavar="N", help="how many of the photos (default: 5)")
    parser.add_argument("--scaling", type=int, metavar="N", help="match growing numbers of small images, up to N")
    parser.add_argument("--out", type=Path, metavar="OUT", help="folder for the images and the curve of --scaling")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows to this file, too")
    text = "change a setting of hm_sfm, as in hm-sfm reconstruct"
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE", help=text)
    options = parser.parse_args()
    if (options.scaling is None) != (options.out is None):
        parser.error("--scaling and --out need each other")
    try:
        if options.scaling:
            rows = benchmark_scaling(options.photos, options.out, options.scaling, options.configs[0], options.settings)
        else:
            rows = benchmark(
                options.photos, options.sizes, options.configs, options.methods, options.count, options.settings
            )
    except HmSfmError as error:
        parser.exit(error.exit_code, f"{parser.prog}: {error}\n")
    print(format_table(rows))
    if options.json:
        write_json(options.json, rows)


if __name__ == "__main__":
    main()
