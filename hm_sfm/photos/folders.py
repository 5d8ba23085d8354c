"""Which files of a folder may be photos: subfolders and linked folders, without what programs and devices put there."""

import logging
import os
from pathlib import Path

from hm_sfm.errors import InputError
from hm_sfm.io.markers import is_marked

logger = logging.getLogger(__name__)

DEVICE_FOLDERS = ("@eadir", "@__thumb", "@recycle", "#recycle", "#snapshot", "$recycle.bin", "__macosx", "lost+found")
"""Thumbnails and deleted files on network storage and removable disks; in lower case."""


def find_files(folder: Path) -> list[str]:
    """Paths below `folder`, relative to it, of all files but hidden ones; sorted.

    Linked folders are searched as well, each folder once: links may lead in circles. What hm_sfm or a storage device
    made, and what cannot be searched, is left out with a warning. Raises InputError where `folder` is not a folder.
    """
    if not folder.is_dir():
        raise InputError(f"the image folder {folder} " + ("is not a folder" if folder.exists() else "does not exist"))
    names: list[str] = []
    left_out: dict[str, list[Path]] = {}
    seen: set[Path] = set()
    own, linked = [folder], []
    while own or linked:
        current = own.pop() if own else linked.pop(0)  # a folder is known by its own name before that of a link
        if current.resolve() in seen:
            continue
        seen.add(current.resolve())
        reason = "" if current == folder else find_reason(current, folder)
        try:
            entries = [] if reason else [entry for entry in os.scandir(current) if not entry.name.startswith(".")]
        except OSError as error:
            entries, reason = [], f"cannot be searched: {error.strerror}"
        if reason:
            left_out.setdefault(reason, []).append(current)
        for entry in sorted(entries, key=lambda entry: entry.name):
            if not os.path.isdir(entry.path):  # unlike its own is_dir, also of a link to itself
                names.append(Path(entry.path).relative_to(folder).as_posix())
            else:
                (linked if entry.is_symlink() else own).append(Path(entry.path))
    for reason, folders in left_out.items():
        more = f", and {len(folders) - 1} more" if len(folders) > 1 else ""
        logger.warning("left out: the folder %s %s%s", min(folders), reason, more)
    return sorted(names)


def find_reason(subfolder: Path, folder: Path) -> str:
    """Why the photos in a subfolder are none of the collection's; empty where they are."""
    if is_marked(subfolder):
        return "was made by hm_sfm"
    if subfolder.name.lower() in DEVICE_FOLDERS:
        return "was made by a storage device"
    if subfolder.resolve() in folder.resolve().parents:
        return "is a link to a folder around the photos"
    return ""
