"""Models on disk: numbered folders, largest model first, that new models replace. What is not ours stays.

A record in the folder of the models says which of them were written here, by their content: people and COLMAP's tools
write models in the same place, or change those that are there.
"""

import hashlib
import json
import logging
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import pycolmap

from hm_sfm.colmap.models import ENDINGS, OPTIONAL, REQUIRED
from hm_sfm.io.atomic import write_json

logger = logging.getLogger(__name__)

RECORD = ".models.json"
MODEL_FILES = tuple(f"{part}{ending}" for part in (*REQUIRED, *OPTIONAL) for ending in ENDINGS)
REPLACED = "replaced"


@dataclass(frozen=True)
class Record:
    """What RECORD holds."""

    written: tuple[str, ...]
    """Digests of the models that were written here."""
    latest: int
    """How many of them the latest call wrote."""
    images: int
    """Of the largest of them."""


def replace_models(models: Sequence[pycolmap.Reconstruction], sparse_folder: Path, work_folder: Path) -> None:
    """Write models to sparse_folder/0, 1, ..., where they take the places of those that were written here before.

    Without models, the earlier ones stay. What somebody else wrote or changed in the place of a model moves aside to
    <number>_kept, and so does a largest model with more images than the new one; both are logged as warnings. Nothing
    else is touched, files within the folders of models neither. work_folder: a folder on the same disk; if the process
    is killed, restore_models brings back what is in it.
    """
    record = _read_record(sparse_folder)
    if not models:
        if sparse_folder.is_dir() and record.written:
            _write_record(sparse_folder, replace(record, latest=0))
        return
    images = models[0].num_reg_images()
    finished, replaced = work_folder / "finished", work_folder / REPLACED
    replaced.mkdir()
    for number, model in enumerate(models):
        (finished / str(number)).mkdir(parents=True)
        model.write_binary(finished / str(number))
    digests = [digest_model(finished / str(number)) for number in range(len(models))]
    sparse_folder.mkdir(exist_ok=True)
    # Known before they are there: whenever the process is killed, what was written here is known as such.
    _write_record(sparse_folder, Record((*record.written, *digests), 0, record.images))
    for number in range(len(models)):
        folder = sparse_folder / str(number)
        if folder.exists():
            is_ours = folder.is_dir() and (not _list_files(folder) or digest_model(folder) in record.written)
            if not is_ours:
                kept = _move_aside(folder)
                logger.warning("%s was written or changed by something else: it is now %s", folder, kept)
            elif number == 0 and _list_files(folder) and record.images > images:
                kept = _move_aside(folder)
                text = "the new model has %d images, that of an earlier run, which is now %s, has %d"
                logger.warning(text, images, kept, record.images)
            else:
                os.replace(folder, replaced / str(number))
        os.replace(finished / str(number), folder)
    restore_models(sparse_folder, work_folder)
    for folder in list(sparse_folder.glob("[0-9]*/")):
        if folder.name.isdecimal() and int(folder.name) >= len(models) and digest_model(folder) in record.written:
            for file in _list_files(folder):
                file.unlink()
            if not any(folder.iterdir()):
                folder.rmdir()
    _write_record(sparse_folder, Record(tuple(digests), len(models), images))


def restore_models(sparse_folder: Path, work_folder: Path) -> None:
    """Bring back what replace_models moved away: files beside those of a model, and models that nothing replaced."""
    for folder in (work_folder / REPLACED).glob("*/"):
        sparse_folder.mkdir(exist_ok=True)
        target = sparse_folder / folder.name
        if not target.exists():
            os.replace(folder, target)
            continue
        for entry in folder.iterdir():
            if entry.name not in MODEL_FILES and not (target / entry.name).exists():
                os.replace(entry, target / entry.name)


def count_latest(sparse_folder: Path) -> int:
    """How many models the latest call of replace_models wrote to a folder; those that were changed do not count."""
    record = _read_record(sparse_folder)
    return sum(digest_model(sparse_folder / str(number)) in record.written for number in range(record.latest))


def digest_model(folder: Path) -> str:
    """A digest of the files of a model."""
    digest = hashlib.sha256()
    for path in _list_files(folder):
        with open(path, "rb") as file:
            digest.update(f"{path.name} {hashlib.file_digest(file, 'sha256').hexdigest()}\n".encode())
    return digest.hexdigest()


def _list_files(folder: Path) -> list[Path]:
    return [folder / name for name in MODEL_FILES if (folder / name).is_file()]


def _move_aside(folder: Path) -> Path:
    """Rename a model to <number>_kept, or <number>_kept_2 and so on; the new path."""
    kept, attempt = folder.with_name(f"{folder.name}_kept"), 1
    while kept.exists():
        attempt += 1
        kept = folder.with_name(f"{folder.name}_kept_{attempt}")
    os.replace(folder, kept)
    return kept


def _read_record(sparse_folder: Path) -> Record:
    try:
        content = json.loads((sparse_folder / RECORD).read_text())
        return Record(tuple(map(str, content["written"])), int(content["latest"]), int(content["images"]))
    except (OSError, ValueError, KeyError, TypeError):
        return Record((), 0, 0)


def _write_record(sparse_folder: Path, record: Record) -> None:
    write_json(sparse_folder / RECORD, asdict(record))
