"""What each command does with its options: run it, print what it made, return the exit code.

Everything that takes long to import is imported by the command that needs it.
"""

import argparse
import json
import math
from pathlib import Path

from hm_sfm.config import Config, MaskConfig, load_config
from hm_sfm.errors import InputError, NoModelError
from hm_sfm.io.atomic import replace_file


def read_config(options: argparse.Namespace) -> Config:
    """The configuration file, overridden by --set, overridden by the options whose names are dotted keys."""
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

    masks = MaskConfig(options.masks or "", options.camera_mask or "") if options.masks or options.camera_mask else None
    convert_run(options.out, options.to, options.target, options.images, masks)
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
    from hm_sfm.pipeline.output_folder import claim_folder
    from hm_sfm.pipeline.reconstruction import reconstruct
    from hm_sfm.synthetic.demo import write_demo

    claim_folder(options.out)
    write_demo(options.out)
    result = reconstruct(options.out / "images", options.out, Config(), options.quiet)
    score = score_model(result.models[0], read_strecha_cameras(options.out / "ground_truth"))
    print_summary(options.out)
    print(
        f"against the ground truth: AUC@1 deg {score.auc_percent[1]:.1f}, AUC@3 deg {score.auc_percent[3]:.1f}, "
        f"median rotation error {score.median_rotation_deg:.3f} deg, translation {score.median_translation_deg:.3f} deg"
    )
    return 0


def run_show(options: argparse.Namespace) -> int:
    from hm_sfm.pipeline.run import load_matcher
    from hm_sfm.report.pair_picture import check_picture_path, draw_pair, write_picture

    check_picture_path(options.picture)
    config = read_config(options)
    matcher = load_matcher(config)
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
    from hm_sfm.pipeline.run import load_matcher
    from hm_sfm.training.photos import load_photos
    from hm_sfm.training.validation import make_validation_pairs

    config = read_config(options)
    matcher = load_matcher(config)
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
        metrics = {name: value if math.isfinite(value) else None for name, value in scores.items()}  # JSON has no NaN
        with replace_file(options.json) as temporary:
            temporary.write_text(json.dumps(metrics, indent=2) + "\n")
    return 0


def run_train(options: argparse.Namespace) -> int:
    from hm_sfm.training.config import TrainConfig
    from hm_sfm.training.loop import train
    from hm_sfm.training.processes import find_processes

    weights = train(load_config(options.config, tuple(options.settings), TrainConfig), options.resume, options.quiet)
    if find_processes().is_first:
        print(f"trained: {weights}")
    return 0


def print_summary(out: Path) -> None:
    """Print the metrics of summary.json in two lines."""
    summary = json.loads((out / "summary.json").read_text())
    print(
        f"{summary['registered']} of {summary['num_images']} images registered, {summary['points']} points, "
        f"mean track length {summary['mean_track_length']:.2f} images, "
        f"mean reprojection error {summary['mean_reprojection_px']:.3f} px"
    )
    print(f"model: {out / 'sparse' / '0'} ({summary['seconds']['total']:.0f} s), report: {out / 'report.html'}")
