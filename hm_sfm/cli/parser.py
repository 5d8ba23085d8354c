"""What can be typed: every command with its arguments and help texts."""

import argparse
from importlib.metadata import version
from pathlib import Path
from typing import NoReturn

from hm_sfm.cli import commands
from hm_sfm.config import Config
from hm_sfm.errors import InputError

EXAMPLES = """examples:
  hm-sfm demo out/demo                     render a small scene, reconstruct it and measure the error
  hm-sfm reconstruct photos out/castle     turn a folder of photos into a COLMAP model, out/castle/sparse/0
  hm-sfm export photos out/castle          stop at out/castle/database.db, for COLMAP's GUI or mapper
  hm-sfm compare photos out/tracks         compare its tracks with those of LoFTR-style matches
  hm-sfm reconstruct --help                list all options of a command

To continue a command that was interrupted or killed, run it again.
exit codes: 0 done, 2 bad arguments or input, 3 no model could be built, 130 interrupted, 143 terminated"""

CONFIG_OPTIONS = (
    ("--pairs", "pairs.mode", "auto|exhaustive|sequential|retrieval|spatial|FILE",
     "which pairs of photos to match: all (exhaustive), neighbours in the order of their names (sequential), photos "
     "that look alike (retrieval), photos taken near each other according to GPS (spatial), or those in a file with "
     "two names per line; auto matches all pairs of up to 60 photos, and a selection beyond that"),
    ("--model", "matching.model", "light|FILE", "weights of the network: bundled ones, or a file made by hm-sfm train"),
    ("--coarse", "matching.coarse", "light|sift|lightglue|xfeat|FILE",
     "where the coarse matches come from, for which homographies are then estimated: the network itself (light), "
     "COLMAP's SIFT, ALIKED with LightGlue, XFeat*, or the coarse stage of a LoFTR checkpoint or of other weights"),
    ("--coarse-matches", "matching.coarse_matches", "FILE",
     "take the coarse matches from this file, as written by hloc: pairs of points from any matcher, or indices"),
    ("--coarse-features", "matching.coarse_features", "FILE",
     "the keypoints, in hloc's format, that the indices in --coarse-matches refer to"),
    ("--device", "matching.device", "auto|cpu|cuda", "where the network runs; auto uses the GPU if there is one"),
    ("--camera-mode", "cameras.mode", "auto|single|per-folder|per-image",
     "which photos share a camera; auto decides by size and EXIF"),
    ("--camera-model", "cameras.model", "NAME", "COLMAP's name of the camera model, for example PINHOLE or OPENCV"),
    ("--camera-params", "cameras.params", "F,...",
     "known intrinsics in px, in the order of the camera model (PINHOLE: fx,fy,cx,cy); they stay fixed. Without them, "
     "the focal length comes from EXIF and is refined"),
    ("--cameras", "cameras.file", "MODEL",
     "take the intrinsics of all photos from this COLMAP model, or from a cameras.txt with an images.txt beside it; "
     "they stay fixed"),
    ("--poses", "cameras.poses", "MODEL",
     "take intrinsics and poses from this COLMAP model; both stay fixed, and only points are triangulated"),
    ("--rig", "cameras.rig", "FILE", "rig_config.json in COLMAP's format, for cameras that are mounted together"),
    ("--masks", "masks.folder", "DIR",
     "ignore what is black in the masks in this folder; the mask of a/b.jpg is a/b.jpg.png and has the same size"),
    ("--camera-mask", "masks.camera", "FILE", "ignore what is black in this mask, in all photos of its size"),
    ("--mapper", "mapping.mapper", "incremental|global",
     "COLMAP's incremental mapper adds one image after another, its global mapper takes all at once"),
)  # fmt: skip
"""Flag, key of the configuration, what it takes, help."""


class Parser(argparse.ArgumentParser):
    """Reports a bad argument like any other bad input: in one line."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (see {self.prog} --help)")


def make_parser() -> argparse.ArgumentParser:
    """All commands and their options."""
    parser = Parser(
        prog="hm-sfm",
        description="3D models from photos: dense matches with homographies, persistent keypoints, COLMAP.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"hm-sfm {version('hm_sfm')}")
    subparsers = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    for name, run, add_options, text, more in (
        ("reconstruct", commands.run_reconstruct, add_reconstruction_options,
         "turn photos into a COLMAP model, OUT/sparse/0",
         "Also writes OUT/pairs.txt, OUT/matches.h5, OUT/refined.h5, OUT/database.db, OUT/summary.json and "
         "OUT/report.html."),
        ("match", commands.run_match, add_match_options,
         "select pairs and match them: OUT/pairs.txt and OUT/matches.h5",
         "To continue from there, run reconstruct or export with the same OUT."),
        ("export", commands.run_export, add_export_options,
         "turn photos into OUT/database.db, verified, for COLMAP's GUI or mapper",
         "The database holds cameras, images, persistent keypoints, matches and two-view geometries."),
        ("merge", commands.run_merge, add_merge_options,
         "merge the parts made by hm-sfm match --shard into OUT/matches.h5",
         "Takes the options that the parts were matched with. To continue from there, run reconstruct or export with "
         "the same OUT."),
        ("compare", commands.run_compare, add_compare_options,
         "reconstruct with persistent keypoints and with LoFTR-style matches, and compare the tracks",
         "Writes OUT/compare.json, OUT/compare.png and the models OUT/METHOD/sparse/0."),
        ("show", commands.run_show, add_show_options,
         "match two photos; draw the matches, and the second photo warped into the first",
         "Writes nothing else. The first line printed says whether reconstruct would use the pair."),
        ("refine", commands.run_refine, add_refine_options,
         "turn a COLMAP database into OUT/database.db with refined, persistent keypoints",
         "Starts from the verified matches of the database, of SIFT or of anything else. The given database is not "
         "changed."),
        ("convert", commands.run_convert, add_convert_options,
         "write the model of a run in the format of another program",
         "Takes the largest model, OUT/sparse/0; for hloc the keypoints and matches of OUT/database.db."),
        ("frames", commands.run_frames, add_frames_options,
         "take photos from videos: the sharpest frame of each interval",
         "The frames of walk.mp4 become IMAGES/walk/walk_<milliseconds>.jpg, listed in IMAGES/walk/frames.csv. Videos "
         "whose frames are already there are skipped."),
        ("demo", commands.run_demo, add_demo_options,
         "render a small scene with known cameras, reconstruct it and print the error",
         "Needs no photos."),
        ("evaluate", commands.run_evaluate, add_evaluate_options,
         "measure the matches of single pairs against ground truth",
         "The ground truth is points, poses or homographies."),
        ("train", commands.run_train, add_train_options,
         "train the network on photos",
         "The configuration names the stage to train, the photos, the output folder and the weights to start from. On "
         "several GPUs: torchrun --nproc-per-node N -m hm_sfm.cli train ..."),
    ):  # fmt: skip
        command = subparsers.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}. {more}")
        command.add_argument("--quiet", action="store_true", help="show no progress bars and no warnings")
        add_options(command)
        command.set_defaults(run=run)
    return parser


def add_reconstruction_options(command: argparse.ArgumentParser) -> None:
    """The options of reconstruct, which match and export have as well."""
    add_photo_options(command)
    text = "match in this process (serial), or on the workers of a Ray cluster (default: serial)"
    command.add_argument("--engine", dest="matching.engine", metavar="serial|ray", help=text)


def add_match_options(command: argparse.ArgumentParser) -> None:
    """The options of match."""
    add_reconstruction_options(command)
    text = "match only part I of N of the pairs, for example 2/8; hm-sfm merge merges the parts"
    command.add_argument("--shard", metavar="I/N", help=text)


def add_export_options(command: argparse.ArgumentParser) -> None:
    """The options of export."""
    add_reconstruction_options(command)
    text = "colmap: OUT/database.db; hloc: OUT/hloc/features.h5 and OUT/hloc/matches.h5 (default: colmap)"
    command.add_argument("--format", choices=("colmap", "hloc"), default="colmap", help=text)


def add_merge_options(command: argparse.ArgumentParser) -> None:
    """The options of merge."""
    command.add_argument("images", metavar="IMAGES", type=Path, help="the folder of photos that was matched")
    command.add_argument("out", metavar="OUT", type=Path, help="the folder that holds all parts")
    add_matching_options(command)


def add_compare_options(command: argparse.ArgumentParser) -> None:
    """The options of compare."""
    add_photo_options(command)
    text = "folder of <image name>.camera files in Strecha's layout: adds the AUC of pose errors"
    command.add_argument("--ground-truth", metavar="DIR", type=Path, help=text)
    text = "weights for the LoFTR-style matches: bundled ones, or a file (default: light_expectation)"
    command.add_argument("--expectation-model", metavar="NAME|FILE", default="light_expectation", help=text)
    text = "a checkpoint of LoFTR: adds LoFTR's own matches, computed by the package kornia"
    command.add_argument("--loftr", metavar="FILE", type=Path, help=text)
    text = "keypoints in hloc's format: adds hloc's result; needs --hloc-matches"
    command.add_argument("--hloc-features", metavar="FILE", type=Path, help=text)
    text = "matches in hloc's format, of the same pairs as the other methods (--pairs FILE); needs --hloc-features"
    command.add_argument("--hloc-matches", metavar="FILE", type=Path, help=text)


def add_show_options(command: argparse.ArgumentParser) -> None:
    """The options of show."""
    command.add_argument("photo_a", metavar="A", type=Path, help="a photo")
    command.add_argument("photo_b", metavar="B", type=Path, help="another photo")
    command.add_argument("picture", metavar="PICTURE", type=Path, help="file to write: .jpg, .png or .webp")
    add_matching_options(command)


def add_refine_options(command: argparse.ArgumentParser) -> None:
    """The options of refine."""
    command.add_argument("database", metavar="DATABASE", type=Path, help="a COLMAP database with verified matches")
    command.add_argument("images", metavar="IMAGES", type=Path, help="the folder of its photos")
    command.add_argument("out", metavar="OUT", type=Path, help="a new folder, or that of an earlier refine")
    add_matching_options(command)


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
    text = "folder of the photos, if they were moved after the run"
    command.add_argument("--images", metavar="DIR", type=Path, help=text)
    command.add_argument("--masks", metavar="DIR", help="folder of the masks, if they were moved after the run")
    command.add_argument("--camera-mask", metavar="FILE", help="the mask of all photos, if it was moved after the run")


def add_frames_options(command: argparse.ArgumentParser) -> None:
    """The options of frames."""
    command.add_argument("videos", metavar="VIDEO", type=Path, nargs="+", help="a video that FFmpeg can decode")
    command.add_argument("images", metavar="IMAGES", type=Path, help="folder for the photos; may exist")
    text = "length of an interval (default: 1)"
    command.add_argument("--every", metavar="SECONDS", type=float, default=1.0, help=text)
    text = "file format of the photos (default: jpg)"
    command.add_argument("--format", choices=("jpg", "png"), default="jpg", help=text)


def add_demo_options(command: argparse.ArgumentParser) -> None:
    """The options of demo."""
    command.add_argument("out", metavar="OUT", type=Path, help="folder for the photos and the model")


def add_evaluate_options(command: argparse.ArgumentParser) -> None:
    """The options of evaluate."""
    tasks = ("points", "poses", "homographies")
    command.add_argument("task", metavar="TASK", choices=tasks, help="points, poses or homographies")
    text = (
        "points: a folder of photos like those used for training; every 15th is made into pairs with exact geometry. "
        "poses: a folder in Strecha's layout (images/, gt_dense_cameras/, K.txt), or a file in SuperGlue's "
        "pairs_with_gt format. homographies: a folder in HPatches' layout"
    )
    command.add_argument("data", metavar="DATA", type=Path, help=text)
    command.add_argument("--images", metavar="DIR", type=Path, help="folder of the images that a pairs file names")
    text = "points: rendered scenes with parallax and occlusion, or warped photos (default: rendered)"
    command.add_argument("--kind", choices=("rendered", "warped"), default="rendered", help=text)
    command.add_argument("--count", metavar="N", type=int, default=50, help="points: number of pairs (default: 50)")
    text = "draw the matches of each pair into this folder: green ones are correct, red ones off by 5 px or more"
    command.add_argument("--pictures", metavar="DIR", type=Path, help=text)
    command.add_argument("--json", metavar="FILE", type=Path, help="also write the metrics to this file")
    add_matching_options(command)


def add_train_options(command: argparse.ArgumentParser) -> None:
    """The options of train."""
    text = "YAML file, for example configs/train_light.yaml"
    command.add_argument("--config", type=Path, metavar="FILE", required=True, help=text)
    command.add_argument("--resume", action="store_true", help="continue from the last checkpoint, if there is one")
    add_settings(command, "steps=1000")


def add_matching_options(command: argparse.ArgumentParser) -> None:
    """The options of commands that only need the settings of the matcher."""
    for flag, key, metavar, text in CONFIG_OPTIONS:
        if key.startswith("matching."):
            command.add_argument(flag, dest=key, metavar=metavar, help=text)
    add_config(command, "matching.max_matches=4000")


def add_photo_options(command: argparse.ArgumentParser) -> None:
    """The options of commands that reconstruct a folder of photos, or a part of the way."""
    command.add_argument("images", metavar="IMAGES", type=Path, help="folder of photos, searched with its subfolders")
    text = "folder for all results: a new one, or that of an earlier run"
    command.add_argument("out", metavar="OUT", type=Path, help=text)
    defaults = Config()
    for flag, key, metavar, text in CONFIG_OPTIONS:
        section, field = key.split(".")
        default = getattr(getattr(defaults, section), field)
        text = f"{text} (default: {default})" if default else text
        command.add_argument(flag, dest=key, metavar=metavar, help=text)
    add_config(command, "images.long_edge_px=1600")


def add_config(command: argparse.ArgumentParser, example: str) -> None:
    """--config and --set."""
    command.add_argument("--config", type=Path, metavar="FILE", help="YAML file of settings, like configs/light.yaml")
    add_settings(command, example)


def add_settings(command: argparse.ArgumentParser, example: str) -> None:
    """--set, for any key of the configuration."""
    text = f"change one setting of the configuration, for example {example}; may be repeated"
    command.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE", help=text)
