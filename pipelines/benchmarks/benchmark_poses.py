"""Relative poses from single pairs of scenes whose cameras are known: hm_sfm against XFeat* and ALIKED + LightGlue.

    peers/bin/python pipelines/benchmarks/benchmark_poses.py fountain-P11 Herz-Jesus-P8 --json poses.json

peers.py describes the environment `peers`. SCENE has the layout of Strecha's data sets: images/, gt_dense_cameras/ and
K.txt. All methods match all pairs of a scene at the same long edge. The essential matrices are estimated by the same
two RANSACs: OpenCV's, as LoFTR does, and COLMAP's LO-RANSAC.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from peers import AlikedLightGlue, HmSfm, HmSfmAll, Matcher, XfeatStar
from tables import format_table

from hm_sfm.config import Config, load_config
from hm_sfm.errors import HmSfmError
from hm_sfm.evaluation.relative_poses import PosePair, read_strecha_pairs, score_pose_matches
from hm_sfm.io.atomic import write_json

METHODS = {
    "hm_sfm": HmSfm,
    "hm_sfm_all": HmSfmAll,  # with the matches below the score that a reconstruction asks for
    "aliked_lightglue": AlikedLightGlue,
    "xfeat_star": XfeatStar,
}


def benchmark_poses(scenes: Sequence[Path], methods: Sequence[str], config: Config) -> list[dict[str, object]]:
    """One row per scene and method. Raises InputError on an unusable scene and where a peer is not installed."""
    pairs_of = {scene: read_strecha_pairs(scene) for scene in scenes}
    matchers = {method: METHODS[method](config) for method in methods}
    rows = []
    for scene, pairs in pairs_of.items():
        for method, matcher in matchers.items():
            print(f"{scene.name}: {method}", file=sys.stderr)
            rows.append({"scene": scene.name, "method": method} | score_method(matcher, pairs))
    return rows


def score_method(matcher: Matcher, pairs: Sequence[PosePair]) -> dict[str, float]:
    """AUC in percent by RANSAC and threshold, matches and seconds per pair; each photo is encoded once."""
    before = matcher.seconds
    scores = score_pose_matches(matcher.match, pairs)
    names = {name: name.replace("_auc_", "@").removesuffix("deg") for name in scores if "_auc_" in name}
    return {short: scores[name] for name, short in names.items()} | {
        "matches": round(scores["mean_matches"]),
        "seconds": (matcher.seconds - before) / len(pairs),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", metavar="SCENE", type=Path, nargs="+")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="default: all")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows to this file, too")
    text = "change a setting of hm_sfm, as in hm-sfm reconstruct"
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE", help=text)
    options = parser.parse_args()
    try:
        rows = benchmark_poses(options.scenes, options.methods, load_config(None, tuple(options.settings)))
    except HmSfmError as error:
        parser.exit(error.exit_code, f"{parser.prog}: {error}\n")
    print(format_table(rows))
    if options.json:
        write_json(options.json, rows)


if __name__ == "__main__":
    main()
