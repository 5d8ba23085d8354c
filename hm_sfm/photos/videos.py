"""Frames of videos as photos: the sharpest one of each interval of time, with its time in its name."""

import csv
import hashlib
import logging
import math
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from hm_sfm.config import fingerprint
from hm_sfm.errors import ConfigError, InputError
from hm_sfm.io.atomic import make_folder
from hm_sfm.io.names import cut_name
from hm_sfm.io.pictures import encode_picture
from hm_sfm.photos.images import EXTENSIONS

logger = logging.getLogger(__name__)

FORMATS = ("jpg", "png")
TABLE = "frames.csv"
MARKER = ".frames"
"""File that marks a folder as the frames of a video, and says how they were chosen."""
SHARPNESS_EDGE_PX = 1024
"""Sharpness is measured at the size that photos are matched at: noise and compression look sharp in larger frames."""
LOST_SHARE = 0.1
"""Share of the frames that a video declares: if more than these cannot be decoded, a warning says so."""


def extract_frames(
    videos: Sequence[Path], image_folder: Path, every_s: float = 1.0, image_format: str = "jpg", quiet: bool = False
) -> dict[str, float]:
    """Write the sharpest frame of each `every_s` seconds of each video, upright, into a folder of photos.

    The frames of walk.mp4 are image_folder/walk/walk_<milliseconds from the start>.jpg, so that the order of their
    names is that of time; image_folder/walk/frames.csv lists them. A video's folder appears whole or not at all, and
    is kept where it holds the same frames already. image_format: jpg or png.

    Returns the image names, relative to image_folder, with seconds from the start of their video.

    Raises ConfigError on an impossible interval or format, InputError where a video cannot be decoded, two would have
    the same folder, or that folder holds anything else. All of this
    is checked before anything is written, except for damage further inside a video.
    """
    image_folder = Path(image_folder)
    if not (math.isfinite(every_s) and every_s >= 0.001):
        raise ConfigError(f"frames can be taken every 0.001 seconds or less often, found {every_s}")
    if image_format not in FORMATS:
        raise ConfigError(f"the format of frames must be {' or '.join(FORMATS)}, found {image_format!r}")
    every_ms = round(every_s * 1000)
    jobs: dict[str, tuple[Path, str]] = {}
    for video in map(Path, videos):
        digest = check_video(video)
        # Some file systems tell no case apart.
        other = next((name for name in jobs if name.casefold() == video.stem.casefold()), None)
        if other is not None:
            raise InputError(
                f"{jobs[other][0]} and {video} would have the same folder {image_folder / video.stem}: rename one"
            )
        jobs[video.stem] = (video, fingerprint(digest, every_ms, image_format))
    kept = {stem for stem, (_, made_by) in jobs.items() if is_done(image_folder / stem, made_by)}
    for stem, (video, made_by) in jobs.items():
        if stem not in kept:
            write_frames(video, image_folder / stem, every_ms, image_format, made_by, quiet)
    return {name: seconds for stem in jobs for name, seconds in read_table(image_folder / stem / TABLE).items()}


def check_video(path: Path) -> str:
    """16 hex digits of a video's bytes. Raises InputError where its first frame cannot be decoded."""
    if not path.is_file():
        raise InputError(f"the video {path} " + ("is not a file" if path.exists() else "does not exist"))
    is_photo = path.suffix.lower() in EXTENSIONS and path.suffix.lower() != ".gif"  # which may move
    if is_photo or next(read_frames(path), None) is None:
        raise InputError(f"{path} cannot be decoded as a video")
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]


def is_done(folder: Path, made_by: str) -> bool:
    """Whether a folder holds these frames already. Raises InputError where it holds anything else."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return False
    marker = folder / MARKER
    if not marker.is_file():
        raise InputError(f"{folder} is there already and holds no frames of a video: name another folder of photos")
    if marker.read_text() != made_by:
        raise InputError(f"{folder} holds frames of another video or interval: delete it, or name another folder")
    return True


def write_frames(video: Path, folder: Path, every_ms: int, image_format: str, made_by: str, quiet: bool) -> None:
    """The chosen frames of one video, their table and the marker; the folder appears whole."""
    with make_folder(folder) as temporary:
        rows = []
        for milliseconds, frame in choose_sharpest(count_frames(video, quiet), every_ms):
            name = f"{cut_name(video.stem, 200)}_{milliseconds:08d}.{image_format}"
            (temporary / name).write_bytes(encode_picture(frame, f".{image_format}"))
            rows.append((f"{folder.name}/{name}", f"{milliseconds / 1000:.3f}"))
        with open(temporary / TABLE, "w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([("name", "seconds"), *rows])
        (temporary / MARKER).write_text(made_by)


def read_table(path: Path) -> dict[str, float]:
    """Image name -> seconds, of a frames.csv."""
    with open(path, newline="", encoding="utf-8") as file:
        return {row["name"]: float(row["seconds"]) for row in csv.DictReader(file)}


def choose_sharpest(frames: Iterable[tuple[int, np.ndarray]], every_ms: int) -> Iterator[tuple[int, np.ndarray]]:
    """Of frames with rising milliseconds, the sharpest of each interval that has any; the first one of several."""
    best: tuple[int, np.ndarray] | None = None
    sharpest = 0.0
    for milliseconds, frame in frames:
        if best and milliseconds // every_ms > best[0] // every_ms:
            yield best
            best = None
        sharpness = measure_sharpness(frame)
        if best is None or sharpness > sharpest:
            best, sharpest = (milliseconds, frame), sharpness
    if best:
        yield best


def measure_sharpness(frame: np.ndarray) -> float:
    """Variance of the Laplacian of a (H, W, 3) uint8 BGR frame, reduced: larger is sharper."""
    grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
    scale = min(1.0, SHARPNESS_EDGE_PX / max(grey.shape))
    grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else grey
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())


def count_frames(path: Path, quiet: bool) -> Iterator[tuple[int, np.ndarray]]:
    """read_frames with a progress bar; a video that ends early is logged as a warning."""
    with open_video(path) as video:
        expected = max(int(video.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
    decoded = 0
    with tqdm(total=expected or None, desc=path.name, unit="frame", disable=quiet) as progress:
        for frame in read_frames(path):
            yield frame
            decoded += 1
            progress.update()
    if decoded < (1 - LOST_SHARE) * expected:
        logger.warning("%s is damaged: %d of its %d frames could be decoded", path, decoded, expected)


def read_frames(path: Path) -> Iterator[tuple[int, np.ndarray]]:
    """Every frame of a video that can be decoded, in order.

    Gives milliseconds from the start, which never fall, and the (H, W, 3) uint8 BGR pixels, rotated upright as the
    video says.
    """
    milliseconds = 0
    with open_video(path) as video:
        while True:
            is_read, frame = video.read()
            if not is_read:
                return
            milliseconds = max(milliseconds, round(video.get(cv2.CAP_PROP_POS_MSEC)))
            yield milliseconds, frame


@contextmanager
def open_video(path: Path) -> Iterator[cv2.VideoCapture]:
    """A video to read, opened or not."""
    # What FFmpeg and OpenCV print about damaged files would stand beside our own line.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    # Other backends would take a name with digits for a series of pictures.
    video = cv2.VideoCapture(str(path.resolve()), cv2.CAP_FFMPEG)
    try:
        yield video
    finally:
        video.release()
        cv2.utils.logging.setLogLevel(level)
