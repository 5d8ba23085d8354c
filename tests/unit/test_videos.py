"""Frames of videos: which are taken, how they are called, and videos that are none."""

import csv
import logging
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from hm_sfm.cli import main
from hm_sfm.errors import ConfigError, InputError
from hm_sfm.photos.images import list_images
from hm_sfm.photos.videos import choose_sharpest, extract_frames, measure_sharpness

FPS = 10
SHARP = (3, 14, 20)
"""Frames of the test's video that are not blurred."""


def write_video(path: Path, count: int = 25) -> Path:
    """Frame i is of brightness about 10 i; all but those of SHARP are blurred."""
    code = {".avi": "MJPG", ".mp4": "mp4v"}[path.suffix]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), FPS, (128, 96))
    assert writer.isOpened()
    pattern = np.random.default_rng(0).integers(-10, 10, (12, 16), np.int16)
    for number in range(count):
        frame = np.kron(pattern, np.ones((8, 8), np.int16)) + 10 * number
        frame = np.dstack([frame.clip(0, 255).astype(np.uint8)] * 3)
        writer.write(frame if number in SHARP else cv2.GaussianBlur(frame, (0, 0), 4))
    writer.release()
    return path


@pytest.fixture
def video(tmp_path) -> Path:
    return write_video(tmp_path / "walk.avi")


@pytest.mark.parametrize("suffix", [".avi", ".mp4"])
def test_the_sharpest_frame_of_each_second_with_its_time(suffix, tmp_path):
    video, photos = write_video(tmp_path / f"walk{suffix}"), tmp_path / "photos"
    frames = extract_frames([video], photos, quiet=True)
    names = ["walk/walk_00000300.jpg", "walk/walk_00001400.jpg", "walk/walk_00002000.jpg"]
    assert frames == dict(zip(names, (0.3, 1.4, 2.0)))
    assert [image.name for image in list_images(photos).images] == names
    for name, number in zip(names, SHARP):
        assert cv2.imread(str(photos / name)).mean() == pytest.approx(10 * number, abs=4)
    with open(photos / "walk" / "frames.csv", newline="") as file:
        rows = list(csv.reader(file))
    assert rows == [["name", "seconds"], *map(list, zip(names, ("0.300", "1.400", "2.000")))]
    assert sorted(path.name for path in photos.iterdir()) == ["walk"]


def test_a_video_with_a_name_as_long_as_can_be(video, tmp_path):
    long = video.rename(tmp_path / ("ü" * 125 + ".avi"))
    frames = extract_frames([long], tmp_path / "photos", 1.0, quiet=True)
    assert [image.name for image in list_images(tmp_path / "photos").images] == list(frames) and len(frames) == 3
    assert all(name.startswith("ü" * 125 + "/" + "ü" * 100 + "_0000") for name in frames)


def test_a_gif_that_moves_is_a_video(tmp_path):
    pictures = [Image.fromarray(np.full((48, 64), 40 * k, np.uint8)) for k in range(4)]
    pictures[0].save(tmp_path / "a.gif", save_all=True, append_images=pictures[1:], duration=1000)
    assert len(extract_frames([tmp_path / "a.gif"], tmp_path / "photos", 1.0, quiet=True)) == 4


def test_what_is_done_is_left_alone_and_the_rest_is_done(video, tmp_path):
    photos = tmp_path / "photos"
    extract_frames([video], photos, 0.5, "png", quiet=True)
    assert len(list((photos / "walk").glob("*.png"))) == 5
    before = {path: path.stat().st_mtime_ns for path in photos.rglob("*")}
    other = write_video(tmp_path / "back.avi", 5)
    frames = extract_frames([video, other], photos, 0.5, "png", quiet=True)
    assert list(frames)[-1] == "back/back_00000300.png" and len(frames) == 6
    assert all(path.stat().st_mtime_ns == time for path, time in before.items() if path != photos)
    for arguments in ((1.0, "png"), (0.5, "jpg")):
        with pytest.raises(InputError, match=f"{photos / 'walk'} holds frames of another video or interval"):
            extract_frames([video], photos, *arguments, quiet=True)
    write_video(video, 24)
    with pytest.raises(InputError, match="holds frames of another video"):
        extract_frames([video], photos, 0.5, "png", quiet=True)


def test_a_folder_that_is_there_is_not_touched(video, tmp_path):
    (tmp_path / "photos" / "walk").mkdir(parents=True)
    own = tmp_path / "photos" / "walk" / "own.jpg"
    own.write_bytes(b"a photo")
    with pytest.raises(InputError, match=f"{own.parent} is there already and holds no frames"):
        extract_frames([video], tmp_path / "photos", quiet=True)
    assert list(own.parent.iterdir()) == [own]


def test_an_interruption_leaves_nothing_and_whole_videos(video, tmp_path, monkeypatch):
    photos = tmp_path / "photos"
    other = write_video(tmp_path / "back.avi", 5)
    encode = cv2.imencode
    written = []

    def interrupt(*arguments):
        written.append(arguments)
        if len(written) == 3:
            raise KeyboardInterrupt
        return encode(*arguments)

    monkeypatch.setattr(cv2, "imencode", interrupt)
    with pytest.raises(KeyboardInterrupt):
        extract_frames([other, video], photos, quiet=True)
    assert [path.name for path in photos.iterdir()] == ["back"]


def test_videos_that_cannot_be_used(video, tmp_path, capfd):
    """Nothing is written, and neither FFmpeg nor OpenCV adds lines of its own."""
    none, text, photo = tmp_path / "none.mp4", tmp_path / "text.mp4", tmp_path / "photo.jpg"
    text.write_text("no video " * 200)
    cv2.imwrite(str(photo), np.zeros((96, 128), np.uint8))
    (tmp_path / "cut.mp4").write_bytes(
        b"\0\0\0\x20ftypisom\0\0\2\0isomiso2avc1mp41\0\0\0\x08free\0\0\1\0mdat" + b"\0" * 99
    )
    for bad in (text, photo, tmp_path / "cut.mp4"):
        assert main(["frames", str(video), str(bad), str(tmp_path / "photos")]) == 2
        assert capfd.readouterr().err.splitlines()[-1] == f"hm-sfm: {bad} cannot be decoded as a video"
    # In a process of its own, because FFmpeg's log level is read once, and the test's own video has been written here.
    command = [sys.executable, "-m", "hm_sfm.cli", "frames", str(tmp_path / "cut.mp4"), str(tmp_path / "photos")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, len(done.stderr.splitlines())) == (2, "", 1), done.stderr
    for bad, reason in ((none, "does not exist"), (tmp_path, "is not a file")):
        with pytest.raises(InputError, match=f"{bad} {reason}"):
            extract_frames([bad], tmp_path / "photos")
    (tmp_path / "sub").mkdir()
    twin = write_video(tmp_path / "sub" / "WALK.avi", 3)
    with pytest.raises(InputError, match="walk.avi and .*WALK.avi would have the same folder"):
        extract_frames([video, twin], tmp_path / "photos")
    assert not (tmp_path / "photos").exists()


@pytest.mark.parametrize("every", ["0", "-1", "nan", "inf", "0.0001"])
def test_impossible_intervals(every, video, tmp_path, capfd):
    assert main(["frames", str(video), str(tmp_path / "photos"), "--every", every]) == 2
    assert f"found {float(every)}" in capfd.readouterr().err
    with pytest.raises(ConfigError, match="jpg or png, found 'gif'"):
        extract_frames([video], tmp_path / "photos", image_format="gif")


def test_a_video_that_ends_early_gives_what_it_has_and_a_warning(video, tmp_path, caplog):
    data = video.read_bytes()
    video.write_bytes(data[: len(data) // 2])
    with caplog.at_level(logging.WARNING, logger="hm_sfm.photos.videos"):
        frames = extract_frames([video], tmp_path / "photos", quiet=True)
    assert next(iter(frames)) == "walk/walk_00000300.jpg" and len(frames) < 3
    (message,) = caplog.messages
    assert message.startswith(f"{video} is damaged: ") and message.endswith("of its 25 frames could be decoded")


def test_choose_sharpest_takes_times_as_they_come():
    flat, sharp = np.full((32, 32, 3), 99, np.uint8), np.zeros((32, 32, 3), np.uint8)
    sharp[::2] = 255
    assert measure_sharpness(sharp) > measure_sharpness(flat) == 0
    frames = [(0, flat), (40, flat), (990, flat), (3000, flat), (3001, sharp), (3999, flat), (4000, flat)]
    assert [time for time, _ in choose_sharpest(iter(frames), 1000)] == [0, 3001, 4000]
    assert list(choose_sharpest(iter([]), 1000)) == []
