"""The command hm-sfm."""

import argparse
import json
import logging
import math
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import NoReturn

from hm_sfm.config import Config, load_config
from hm_sfm.errors import HmSfmError, InputError, NoModelError
from hm_sfm.io.atomic import replace_file

EXAMPLES = """examples:
  hm-sfm demo out/demo                     render a small scene, reconstruct it, compare with the truth
  hm-sfm reconstruct photos out/castle     a folder of photos -> a COLMAP model in out/castle/sparse/0
  hm-sfm export photos out/castle          stop at out/castle/database.db, for COLMAP's GUI or mapper
  hm-sfm compare photos out/tracks         its tracks beside those of LoFTR-style matches: out/tracks/compare.png
  hm-sfm reconstruct --help                all options of a command

An interrupted or killed command goes on where it was when it is started again.
exit codes: 0 done, 2 bad arguments or input, 3 no model could be built, 130 interrupted"""

PHOTO_OPTIONS = (
    ("--pairs", "pairs.mode", "auto|exhaustive|sequential|retrieval|spatial|FILE",
     "which images to match: all with all; neighbours in the order of their names; those that look alike; those taken "
     "near each other by GPS; those of a file with two names a line; or auto, all up to 60 images and a selection "
     "beyond"),
    ("--model", "matching.model", "light|FILE", "the network's weights: bundled ones, or a file made by hm-sfm train"),
    ("--coarse", "matching.coarse", "light|sift|lightglue|xfeat|FILE",
     "what finds the matches that homographies are estimated for: the network itself, COLMAP's SIFT, ALIKED with "
     "LightGlue, XFeat*, or the coarse stage of a LoFTR checkpoint"),
    ("--coarse-matches", "matching.coarse_matches", "FILE",
     "take these matches from a file instead: point pairs of any matcher, or indices, as hloc writes them"),
    ("--coarse-features", "matching.coarse_features", "FILE",
     "the keypoints in hloc's format that the matches of --coarse-matches are indices of"),
    ("--device", "matching.device", "auto|cpu|cuda", "where the network runs; auto takes the GPU if there is one"),
    ("--camera-mode", "cameras.mode", "auto|single|per-folder|per-image",
     "which photos share one camera; auto goes by size and EXIF"),
    ("--camera-model", "cameras.model", "NAME", "COLMAP's camera model, for example PINHOLE or OPENCV"),
    ("--camera-params", "cameras.params", "F,...",
     "known intrinsics in px, in the order of the camera model (PINHOLE: fx,fy,cx,cy), which are then kept as they "
     "are; otherwise the focal length starts from EXIF and is refined"),
    ("--cameras", "cameras.file", "MODEL",
     "a COLMAP model, or its cameras.txt beside its images.txt: the intrinsics of all photos, which are then kept"),
    ("--poses", "cameras.poses", "MODEL",
     "as --cameras, and the poses are kept, too: points are triangulated, nothing else is estimated"),
    ("--rig", "cameras.rig", "FILE",
     "a rig configuration as COLMAP has it, rig_config.json: cameras that are mounted together"),
    ("--masks", "masks.folder", "DIR",
     "do not match what is black in the masks of this folder: that of a/b.jpg is a/b.jpg.png, of the same size"),
    ("--camera-mask", "masks.camera", "FILE", "do not match what is black in this mask, in all photos of its size"),
    ("--mapper", "mapping.mapper", "incremental|global",
     "COLMAP's incremental mapper, image by image, or its global one, all at once"),
)  # fmt: skip
"""Flag, key of the configuration, what it takes, help."""


class Parser(argparse.ArgumentParser):
    """Reports a bad argument as all bad input is reported: in one line."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (see {self.prog} --help)")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code."""
    try:
        options = make_parser().parse_args(arguments)
        level = logging.ERROR if options.quiet else logging.WARNING
        logging.basicConfig(format="%(levelname)s: %(message)s", level=level)
        return options.run(options)
    except HmSfmError as error:
        print(f"hm-sfm: {error}", file=sys.stderr)
        return error.exit_code
    except OSError as error:
        text = f"{error.filename}: {error.strerror}" if error.filename else " ".join(str(error).split())
        print(f"hm-sfm: {text}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("hm-sfm: interrupted; the same command goes on from here", file=sys.stderr)
        return 130


def make_parser() -> argparse.ArgumentParser:
    """All commands and their options."""
    parser = Parser(
        prog="hm-sfm",
        description="3D models from photos: dense matches with homographies, persistent keypoints, COLMAP.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"hm-sfm {version('hm_sfm')}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    quiet = argparse.ArgumentParser(add_help=False)
    quiet.add_argument("--quiet", action="store_true", help="no progress bars, no warnings")

    for name, run, text, more in (
        ("reconstruct", run_reconstruct, "photos -> a COLMAP model in OUT/sparse/0",
         "Also leaves OUT/pairs.txt, OUT/matches.h5, OUT/database.db, OUT/summary.json and OUT/report.html."),
        ("match", run_match, "photos -> pairs and matches only, OUT/pairs.txt and OUT/matches.h5",
         "reconstruct or export with the same OUT goes on from there."),
        ("export", run_export, "photos -> OUT/database.db, verified, for COLMAP's GUI or mapper",
         "The database holds cameras, images, persistent keypoints, matches and two-view geometries."),
    ):  # fmt: skip
        command = commands.add_parser(name, parents=[quiet], help=text, description=f"{text}. {more}")
        add_photo_options(command)
        text = "match in this process, or by the workers of a Ray cluster (default: serial)"
        command.add_argument("--engine", dest="matching.engine", metavar="serial|ray", help=text)
        if name == "match":
            text = "match only part I of N of the pairs, for example 2/8; hm-sfm merge gathers the parts"
            command.add_argument("--shard", metavar="I/N", help=text)
        if name == "export":
            text = "the database, or the files OUT/hloc/features.h5 and OUT/hloc/matches.h5 for hloc (default: colmap)"
            command.add_argument("--format", choices=("colmap", "hloc"), default="colmap", help=text)
        command.set_defaults(run=run)

    text = "gather what hm-sfm match --shard made in OUT/matches.h5"
    more = "Takes the options that the shards were matched with. reconstruct or export with the same OUT goes on."
    command = commands.add_parser("merge", parents=[quiet], help=text, description=f"{text}. {more}")
    command.add_argument("images", metavar="IMAGES", type=Path, help="the folder of photos that was matched")
    command.add_argument("out", metavar="OUT", type=Path, help="the folder that all shards were made in")
    add_matching_options(command)
    command.set_defaults(run=run_merge)

    text = "photos -> models by persistent keypoints and by LoFTR-style matches, with their tracks compared"
    more = "Leaves OUT/compare.json, OUT/compare.png and the models in OUT/METHOD/sparse/0."
    command = commands.add_parser("compare", parents=[quiet], help=text, description=f"{text}. {more}")
    add_photo_options(command)
    add_compare_options(command)

    text = "match two photos and draw their matches, and the second warped into the first"
    more = "Nothing else is written. The line that is printed says whether reconstruct would use the pair."
    command = commands.add_parser("show", parents=[quiet], help=text, description=f"{text}. {more}")
    command.add_argument("photo_a", metavar="A", type=Path, help="a photo")
    command.add_argument("photo_b", metavar="B", type=Path, help="another photo")
    command.add_argument("picture", metavar="PICTURE", type=Path, help="file to write: .jpg, .png or .webp")
    add_matching_options(command)
    command.set_defaults(run=run_show)

    text = "an existing COLMAP database -> OUT/database.db with refined, persistent keypoints"
    more = "Starts from its verified matches, of SIFT or anything else. The given database stays as it is."
    command = commands.add_parser("refine", parents=[quiet], help=text, description=f"{text}. {more}")
    command.add_argument("database", metavar="DATABASE", type=Path, help="a COLMAP database with verified matches")
    command.add_argument("images", metavar="IMAGES", type=Path, help="the folder of its photos")
    command.add_argument("out", metavar="OUT", type=Path, help="a new folder, or that of an earlier refinement")
    add_matching_options(command)
    command.set_defaults(run=run_refine)

    text = "the model of a run -> the files of other programs"
    more = "Takes the largest model, OUT/sparse/0; for hloc the keypoints and matches of OUT/database.db."
    command = commands.add_parser("convert", parents=[quiet], help=text, description=f"{text}. {more}")
    add_convert_options(command)

    text = "videos -> a folder of photos: the sharpest frame of each interval"
    more = (
        "The frames of walk.mp4 are IMAGES/walk/walk_<milliseconds>.jpg, listed in IMAGES/walk/frames.csv. Videos whose "
        "frames are there already are left alone."
    )
    command = commands.add_parser("frames", parents=[quiet], help=text, description=f"{text}. {more}")
    command.add_argument("videos", metavar="VIDEO", type=Path, nargs="+", help="a video that FFmpeg can decode")
    command.add_argument("images", metavar="IMAGES", type=Path, help="folder of photos, which may exist")
    text = "length of an interval (default: 1)"
    command.add_argument("--every", metavar="SECONDS", type=float, default=1.0, help=text)
    command.add_argument("--format", choices=("jpg", "png"), default="jpg", help="of the photos (default: jpg)")
    command.set_defaults(run=run_frames)

    text = "render a small scene with known cameras, reconstruct it and print the error"
    command = commands.add_parser("demo", parents=[quiet], help=text, description=f"{text}. Needs no photos.")
    command.add_argument("out", metavar="OUT", type=Path, help="folder for the photos and the model")
    command.set_defaults(run=run_demo)

    text = "measure the matches of single pairs against known points, poses or homographies"
    command = commands.add_parser("evaluate", parents=[quiet], help=text, description=text)
    add_evaluate_options(command)

    text = "train the network on photos"
    more = (
        "The configuration names the stage, the photos, the output folder and the weights to start from. Several GPUs: "
        "torchrun --nproc-per-node N -m hm_sfm.cli train ..."
    )
    command = commands.add_parser("train", parents=[quiet], help=text, description=f"{text}. {more}")
    text = "YAML file, for example configs/train_light.yaml"
    command.add_argument("--config", type=Path, metavar="FILE", required=True, help=text)
    command.add_argument("--resume", action="store_true", help="go on from the last checkpoint, if there is one")
    add_settings(command, "steps=1000")
    command.set_defaults(run=run_train)
    return parser


def add_convert_options(command: argparse.ArgumentParser) -> None:
    """The options of convert."""
    command.add_argument("out", metavar="OUT", type=Path, help="folder of an earlier run")
    text = (
        "hloc: features.h5 and matches.h5; nerfstudio: undistorted images, transforms.json and points; 3dgs: "
        "undistorted images and their model, for Gaussian splatting; ply: the points; txt: COLMAP's text files"
    )
    formats = ("hloc", "nerfstudio", "3dgs", "ply", "txt")
    command.add_argument("--to", choices=formats, required=True, help=text)
    command.add_argument("target", metavar="DEST", type=Path, help="a new folder; for ply, a new file")
    text = "folder of the photos, if it is no longer where it was in the run"
    command.add_argument("--images", metavar="DIR", type=Path, help=text)
    command.set_defaults(run=run_convert)


def add_compare_options(command: argparse.ArgumentParser) -> None:
    """The options of compare beside those of all commands that take photos."""
    text = "folder of <image name>.camera files in Strecha's layout: adds the AUC of pose errors"
    command.add_argument("--ground-truth", metavar="DIR", type=Path, help=text)
    text = "weights of the LoFTR-style matches: bundled ones, or a file (default: light_expectation)"
    command.add_argument("--expectation-model", metavar="NAME|FILE", default="light_expectation", help=text)
    text = "a checkpoint of LoFTR: adds its own matches, through the package kornia"
    command.add_argument("--loftr", metavar="FILE", type=Path, help=text)
    text = "keypoints in hloc's format: adds hloc's result; needs --hloc-matches"
    command.add_argument("--hloc-features", metavar="FILE", type=Path, help=text)
    text = "matches in hloc's format, of the same pairs as all methods (--pairs FILE); needs --hloc-features"
    command.add_argument("--hloc-matches", metavar="FILE", type=Path, help=text)
    command.set_defaults(run=run_compare)


def add_evaluate_options(command: argparse.ArgumentParser) -> None:
    """The options of evaluate."""
    text = (
        "points: a folder of photos like those trained on, every 15th of which makes pairs with exact geometry; poses: "
        "a folder in Strecha's layout (images/, gt_dense_cameras/, K.txt), or a file in SuperGlue's pairs_with_gt "
        "format; homographies: a folder in HPatches' layout"
    )
    tasks = ("points", "poses", "homographies")
    command.add_argument("task", metavar="TASK", choices=tasks, help="points, poses or homographies")
    command.add_argument("data", metavar="DATA", type=Path, help=text)
    command.add_argument("--images", metavar="DIR", type=Path, help="folder of the images that a pairs file names")
    text = "points: rendered scenes with parallax and occlusion, or warped photos (default: rendered)"
    command.add_argument("--kind", choices=("rendered", "warped"), default="rendered", help=text)
    command.add_argument("--count", metavar="N", type=int, default=50, help="points: how many pairs (default: 50)")
    text = "draw the matches of each pair into this folder: green ones are right, red ones 5 px off or more"
    command.add_argument("--pictures", metavar="DIR", type=Path, help=text)
    command.add_argument("--json", metavar="FILE", type=Path, help="write the figures to this file, too")
    add_matching_options(command)
    command.set_defaults(run=run_evaluate)


def add_matching_options(command: argparse.ArgumentParser) -> None:
    """The options of commands that need the settings of the matcher only."""
    for flag, key, metavar, text in PHOTO_OPTIONS:
        if key.startswith("matching."):
            command.add_argument(flag, dest=key, metavar=metavar, help=text)
    command.add_argument("--config", type=Path, metavar="FILE", help="YAML file of settings like configs/light.yaml")
    add_settings(command, "matching.coarse_threshold=0.7")


def add_photo_options(command: argparse.ArgumentParser) -> None:
    """The options of all commands that take a folder of photos."""
    command.add_argument("images", metavar="IMAGES", type=Path, help="folder of photos, searched with its subfolders")
    text = "folder for everything that is made: a new one, or that of an earlier run"
    command.add_argument("out", metavar="OUT", type=Path, help=text)
    defaults = Config()
    for flag, key, metavar, text in PHOTO_OPTIONS:
        section, field = key.split(".")
        default = getattr(getattr(defaults, section), field)
        text = f"{text} (default: {default})" if default else text
        command.add_argument(flag, dest=key, metavar=metavar, help=text)
    command.add_argument("--config", type=Path, metavar="FILE", help="YAML file of settings like configs/light.yaml")
    add_settings(command, "images.long_edge_px=1600")


def add_settings(command: argparse.ArgumentParser, example: str) -> None:
    """--set, for any key of the configuration."""
    text = f"change one setting of the configuration, for example {example}; may be repeated"
    command.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE", help=text)


def read_config(options: argparse.Namespace) -> Config:
    """The configuration file, then --set, then the options with names of their own."""
    named = {key: value for key, value in vars(options).items() if "." in key and value is not None}
    return load_config(options.config, tuple(options.settings), options=named)


def run_match(options: argparse.Namespace) -> int:
    from hm_sfm.matching.shards import Shard
    from hm_sfm.pipeline.reconstruction import match_photos

    shard = None if options.shard is None else Shard.parse(options.shard)
    matched = match_photos(options.images, options.out, read_config(options), options.quiet, shard)
    matches = shard.locate(options.out) if shard else options.out / "matches.h5"
    print(f"{len(matched.pairs)} pairs of {len(matched.images)} images matched: {matches}")
    return 0


def run_merge(options: argparse.Namespace) -> int:
    from hm_sfm.pipeline.reconstruction import merge_matches

    count = merge_matches(options.images, options.out, read_config(options))
    print(f"{count} pairs: {options.out / 'matches.h5'}")
    return 0


def run_export(options: argparse.Namespace) -> int:
    from hm_sfm.pipeline.reconstruction import export_database, export_hloc

    if options.format == "hloc":
        matched = export_hloc(options.images, options.out, read_config(options), options.quiet)
        files = f"{options.out / 'hloc' / 'features.h5'}, {options.out / 'hloc' / 'matches.h5'}"
    else:
        matched = export_database(options.images, options.out, read_config(options), options.quiet)
        files = str(options.out / "database.db")
    print(f"{len(matched.images)} images and their keypoints: {files}")
    return 0


def run_compare(options: argparse.Namespace) -> int:
    from hm_sfm.evaluation.comparison import compare
    from hm_sfm.evaluation.comparison_report import format_table, plot_tracks, require_plots, write_comparison

    if (options.hloc_features is None) != (options.hloc_matches is None):
        raise InputError("--hloc-features and --hloc-matches need each other: hloc keeps one run in two files")
    require_plots()
    comparison = compare(
        options.images,
        options.out,
        read_config(options),
        expectation_model=options.expectation_model,
        ground_truth=options.ground_truth,
        loftr=options.loftr,
        hloc=(options.hloc_features, options.hloc_matches) if options.hloc_features else None,
        quiet=options.quiet,
    )
    write_comparison(options.out / "compare.json", comparison)
    plot_tracks(options.out / "compare.png", comparison)
    print(format_table(comparison))
    print(f"{options.out / 'compare.json'}, {options.out / 'compare.png'}; models: {options.out}/METHOD/sparse/0")
    if not any(method.registered for method in comparison.methods):
        raise NoModelError(
            f"no method could build a model from {comparison.num_images} images; matches and databases are kept in "
            f"{options.out}"
        )
    return 0


def run_reconstruct(options: argparse.Namespace) -> int:
    from hm_sfm.pipeline.reconstruction import reconstruct

    reconstruct(options.images, options.out, read_config(options), options.quiet)
    print_summary(options.out)
    return 0


def run_refine(options: argparse.Namespace) -> int:
    from hm_sfm.pipeline.refine_database import refine_database

    config = read_config(options)
    matched, database = refine_database(options.database, options.images, options.out, config, options.quiet)
    print(f"{len(matched.images)} images, {len(matched.pairs)} pairs and their refined keypoints: {database}")
    return 0


def run_convert(options: argparse.Namespace) -> int:
    from hm_sfm.export.conversion import convert_run

    convert_run(options.out, options.to, options.target, options.images)
    print(f"{options.to}: {options.target}")
    return 0


def run_frames(options: argparse.Namespace) -> int:
    from hm_sfm.photos.videos import extract_frames

    frames = extract_frames(options.videos, options.images, options.every, options.format, options.quiet)
    print(f"{len(frames)} frames of {len(options.videos)} videos: {options.images}")
    return 0


def run_demo(options: argparse.Namespace) -> int:
    from hm_sfm.evaluation.poses import score_model
    from hm_sfm.formats.strecha import read_strecha_cameras
    from hm_sfm.pipeline.reconstruction import claim_folder, reconstruct
    from hm_sfm.synthetic.demo import write_demo

    claim_folder(options.out)
    write_demo(options.out)
    result = reconstruct(options.out / "images", options.out, Config(), options.quiet)
    score = score_model(result.models[0], read_strecha_cameras(options.out / "ground_truth"))
    print_summary(options.out)
    print(
        f"against the truth: AUC@1 deg {score.auc_percent[1]:.1f}, AUC@3 deg {score.auc_percent[3]:.1f}, "
        f"median rotation error {score.median_rotation_deg:.3f} deg, translation {score.median_translation_deg:.3f} deg"
    )
    return 0


def run_show(options: argparse.Namespace) -> int:
    from hm_sfm.matching.matcher import HomoMatcher
    from hm_sfm.report.pair_picture import check_picture_path, draw_pair, write_picture

    check_picture_path(options.picture)
    config = read_config(options)
    matcher = HomoMatcher.from_pretrained(
        config.matching.model, config=config.matching, images=config.images, network=config.network
    )
    shown = draw_pair(matcher, options.photo_a, options.photo_b, config.verification)
    write_picture(options.picture, shown.picture)
    print(
        f"{options.photo_a.name}, {options.photo_b.name}: {shown.matches} matches, {shown.good} of them good, "
        f"{shown.agreeing} agree with one geometry: {'verified' if shown.is_verified else 'not verified'}"
    )
    print(f"picture: {options.picture}")
    return 0


def run_evaluate(options: argparse.Namespace) -> int:
    from hm_sfm.evaluation.homographies import score_homographies
    from hm_sfm.evaluation.match_pictures import MatchPictures
    from hm_sfm.evaluation.points import score_points
    from hm_sfm.evaluation.relative_poses import read_strecha_pairs, read_superglue_pairs, score_poses
    from hm_sfm.matching.matcher import HomoMatcher
    from hm_sfm.training.photos import load_photos
    from hm_sfm.training.validation import make_validation_pairs

    config = read_config(options)
    matcher = HomoMatcher.from_pretrained(
        config.matching.model, config=config.matching, images=config.images, network=config.network
    )
    pictures = MatchPictures(options.pictures) if options.pictures else None
    if options.task == "points":
        pairs = make_validation_pairs(load_photos(options.data), options.kind, options.count)
        observe = pictures and pictures.draw_points
        scores = score_points(matcher, pairs, config.verification.min_score, options.quiet, observe)
    elif options.task == "homographies":
        scores = score_homographies(matcher, options.data, options.quiet, pictures and pictures.draw_homography)
    else:
        if options.data.is_file():
            pairs = read_superglue_pairs(options.data, options.images or options.data.parent)
        else:
            pairs = read_strecha_pairs(options.data)
        scores = score_poses(matcher, pairs, options.quiet, pictures and pictures.draw_poses)
    for name, value in scores.items():
        print(f"{name:24} {value:9.2f}")
    if options.json:
        # JSON has no NaN.
        figures = {name: value if math.isfinite(value) else None for name, value in scores.items()}
        with replace_file(options.json) as temporary:
            temporary.write_text(json.dumps(figures, indent=2) + "\n")
    return 0


def run_train(options: argparse.Namespace) -> int:
    from hm_sfm.training.loop import TrainConfig, train
    from hm_sfm.training.processes import find_processes

    weights = train(load_config(options.config, tuple(options.settings), TrainConfig), options.resume, options.quiet)
    if find_processes().is_first:
        print(f"trained: {weights}")
    return 0


def print_summary(out: Path) -> None:
    """What summary.json says, in two lines."""
    summary = json.loads((out / "summary.json").read_text())
    print(
        f"{summary['registered']} of {summary['num_images']} images registered, {summary['points']} points, "
        f"mean track length {summary['mean_track_length']:.2f} images, "
        f"mean reprojection error {summary['mean_reprojection_px']:.3f} px"
    )
    print(f"model: {out / 'sparse' / '0'} ({summary['seconds']['total']:.0f} s), report: {out / 'report.html'}")


if __name__ == "__main__":
    sys.exit(main())
