"""OUT/summary.json: what became of a run, in numbers."""

import dataclasses
import json
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from hm_sfm.config import fingerprint
from hm_sfm.io.atomic import replace_file
from hm_sfm.judgement.judgement import Judgement
from hm_sfm.pipeline.run import Run
from hm_sfm.report.diagnosis import Diagnosis
from hm_sfm.types import MappingResult


def write_summary(run: Run, result: MappingResult, judgement: Judgement, diagnoses: Sequence[Diagnosis]) -> None:
    """OUT/summary.json, atomically."""
    seconds = run.timings.seconds | {"total": run.timings.total}
    masks = dataclasses.asdict(run.config.masks)
    metrics = {
        "image_folder": str(run.collection.folder.resolve()),
        "masks": {kind: str(Path(path).resolve()) if path else "" for kind, path in masks.items()},
        "num_images": result.num_images,
        "skipped_images": run.collection.skipped,
        "registered": result.registered,
        "unregistered": {
            name: f"{diagnosis.cause.value}: {reason}"
            for diagnosis in diagnoses
            for name, reason in diagnosis.reasons.items()
        },
        "pairs_given_up": len(judgement.given_up),
        "matches_denied": judgement.denied_matches,
        "models": len(result.models),
        "points": result.points,
        "observations": result.observations,
        "mean_track_length": round(result.mean_track_length, 4),
        "mean_reprojection_px": round(result.mean_reprojection_px, 4),
        "seconds": {stage: round(spent, 2) for stage, spent in seconds.items()},
        "version": version("hm_sfm"),
        "config_fingerprint": fingerprint(run.config),
    }
    with replace_file(run.out / "summary.json") as temporary:
        temporary.write_text(json.dumps(metrics, indent=2) + "\n")
