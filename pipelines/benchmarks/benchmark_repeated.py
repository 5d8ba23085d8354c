"""Scenes that repeat themselves, rendered, with and without the judgement of pairs: and whether the models fold.

    python pipelines/benchmarks/benchmark_repeated.py --out out/repeated

One row per model: the photos that it holds, and the AUC of its pose errors among them. A folded model holds photos of
both twins in one place, so that few of its poses are right.
"""

import argparse
from pathlib import Path

from tables import format_table

from hm_sfm.config import Config, VerificationConfig
from hm_sfm.errors import NoModelError
from hm_sfm.evaluation.poses import score_model
from hm_sfm.pipeline.reconstruction import reconstruct
from hm_sfm.synthetic.repeated import REPEATED_SCENES, write_repeated

SIZE_WH = (480, 360)


def measure_scene(name: str, folder: Path, judge: bool) -> list[dict[str, object]]:
    """The models of a scene that is rendered into `folder`."""
    views = write_repeated(folder, name, SIZE_WH)
    config = Config(verification=VerificationConfig(judge=judge))
    out = folder / ("judged" if judge else "unjudged")
    row = {"scene": name, "judgement": "yes" if judge else "no"}
    try:
        models = reconstruct(folder / "images", out, config).models
    except NoModelError:
        return [row | {"photos": f"0 of {len(views)}", "auc_1deg": None, "auc_5deg": None, "points": 0}]
    rows = []
    for model in models:
        own = {image.name: views[image.name] for image in model.images.values() if image.has_pose}
        auc = score_model(model, own).auc_percent
        values = {"photos": f"{len(own)} of {len(views)}", "auc_1deg": auc[1], "auc_5deg": auc[5]}
        rows.append(row | values | {"points": model.num_points3D()})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/repeated"), metavar="DIR", help="default: out/repeated")
    parser.add_argument("--scenes", nargs="+", choices=REPEATED_SCENES, default=list(REPEATED_SCENES))
    args = parser.parse_args()
    rows = [
        row for name in args.scenes for judge in (True, False) for row in measure_scene(name, args.out / name, judge)
    ]
    print(format_table(rows))


if __name__ == "__main__":
    main()
