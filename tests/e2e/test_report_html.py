"""OUT/report.html in a browser: Debian's Chromium, headless, without network or GPU."""

import dataclasses
import html
import json
import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from hm_sfm.config import Config
from hm_sfm.report.gather import ImageMetrics, RefutedPair, Report, Scene, WeakPair
from hm_sfm.report.page import render_page
from hm_sfm.types import ImagePair

FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--window-size=1200,900", "--virtual-time-budget=4000",
    "--enable-logging=stderr", "--v=0", "--dump-dom",
)  # fmt: skip

# Chromium's virtual time does not wait for frames: they are drawn at once.
AT_ONCE = "<script>window.requestAnimationFrame = (draw) => draw();</script>"

# Does what a visitor does, and notes after each action whether the picture changed.
VISITOR = """<script>(() => {
  const canvas = document.getElementById("scene");
  canvas.setPointerCapture = () => {};  // there is no real pointer to capture
  const point = (type, id, x, y, more) => canvas.dispatchEvent(
    new PointerEvent(type, { pointerId: id, clientX: x, clientY: y, bubbles: true, ...more }));
  const drag = (more) => {
    point("pointerdown", 1, 300, 300); point("pointermove", 1, 360, 330, more); point("pointerup", 1, 360, 330);
  };
  const pinch = () => {
    point("pointerdown", 1, 300, 300); point("pointerdown", 2, 400, 300);
    point("pointermove", 2, 460, 300); point("pointerup", 1, 300, 300); point("pointerup", 2, 460, 300);
  };
  const actions = {
    nothing: () => {},
    turn: () => drag({}),
    move: () => drag({ shiftKey: true }),
    zoom: () => canvas.dispatchEvent(new WheelEvent("wheel", { deltaY: -300, cancelable: true })),
    pinch,
    key: () => canvas.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowLeft" })),
    cameras: () => document.getElementById("show-cameras").click(),
  };
  const start = canvas.toDataURL();
  const changed = {};
  for (const [name, act] of Object.entries(actions)) {
    const before = canvas.toDataURL();
    act();
    changed[name] = canvas.toDataURL() !== before;
  }
  document.getElementById("show-cameras").click();
  document.getElementById("reset-view").click();
  changed.reset = canvas.toDataURL() !== start;
  const first = () => document.querySelector("#images tbody th").textContent;
  const rows = [first()];
  for (const column of [3, 3, 0]) {
    document.querySelectorAll("#images thead button")[column].click();
    rows.push(first());
  }
  document.body.dataset.visit = JSON.stringify({ changed, rows });
})();</script>"""


@dataclass(frozen=True)
class Visit:
    """A page after its scripts have run."""

    dom: str
    console: list[str]

    @property
    def point_pixels(self) -> int:
        """Pixels of the 3D view that showed a point when it was first drawn."""
        return int(re.search(r'data-point-pixels="([0-9]+)"', self.dom).group(1))


@pytest.fixture(scope="module")
def visit(tmp_path_factory):
    """Open a page in Chromium. Where CI is set, a missing Chromium is a failure."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if not chromium:
        missing = pytest.fail if os.environ.get("CI") else pytest.skip
        missing("Chromium is not installed: the report was not opened in a browser (apt-get install chromium)")

    def open_page(page: Path) -> Visit:
        profile = tmp_path_factory.mktemp("profile")
        command = [chromium, *FLAGS, f"--user-data-dir={profile}", page.as_uri()]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        return Visit(done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line])

    return open_page


@pytest.fixture(scope="module")
def large_report() -> Report:
    """100 images, 4950 verified pairs, the most points and pictures of noise: as large as a report of 100 images is."""
    rng = np.random.default_rng(0)
    images = tuple(
        ImageMetrics(
            name=f"folder {i % 3}/<IMG>_{i}.jpg", registered=True, keypoints=8000, observations=6000 - i,
            mean_error_px=0.3, neighbours=99, reason="",
        )
        for i in range(100)
    )  # fmt: skip
    verified = {(i, j): int(rng.integers(30, 3000)) for i in range(100) for j in range(i + 1, 100)}
    _, code = cv2.imencode(".jpg", rng.integers(0, 255, (420, 1128, 3), np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 75])
    weak = WeakPair(ImagePair("a", "b"), 30, code.tobytes())
    seconds = {"features": 20.0, "match": 900.0, "keypoints": 60.0, "verify": 90.0, "map": 200.0, "total": 1280.0}
    summary = {
        "num_images": 100, "skipped_images": 0, "registered": 100, "models": 1, "points": 300_000,
        "mean_track_length": 6.0, "mean_reprojection_px": 0.4, "seconds": seconds, "version": "1",
        "config_fingerprint": "0",
    }  # fmt: skip
    xyz = rng.normal(size=(100_000, 3))
    frusta = rng.normal(size=(100, 1, 3)) + rng.normal(size=(100, 5, 3)) * 0.05
    return Report(
        title="large",
        summary=summary,
        images=images,
        num_pairs=4950,
        verified_pairs=verified,
        scene=Scene(xyz, rng.integers(0, 255, (100_000, 3)), frusta, tuple(image.name for image in images)),
        track_lengths={"this run": {n: 1000 // n for n in range(2, 60)}},
        weak_pairs=(weak,) * 8,
        refuted_pairs=(RefutedPair(ImagePair("a", "b"), 30, 0.1, code.tobytes()),) * 8,
        diagnoses=(),
        config=Config(),
    )


def test_reconstruct_leaves_a_report_that_a_browser_shows(reconstructed, visit):
    seen = visit(reconstructed / "report.html")
    assert seen.console == []
    assert seen.point_pixels > 500
    summary = json.loads((reconstructed / "summary.json").read_text())
    assert summary["unregistered"] == {}
    assert "5 / 5" in seen.dom and f"{summary['points']:,}" in seen.dom
    assert seen.dom.count("<tr>") >= 6 and "view_04.jpg" in seen.dom
    assert "data:image/jpeg;base64," in seen.dom


def test_what_is_not_in_the_model_is_said_everywhere(scene, tmp_path, run, caplog):
    photos = Path(shutil.copytree(scene.images, tmp_path / "photos"))
    noise = np.random.default_rng(0).integers(0, 255, (240, 320), np.uint8)
    cv2.imwrite(str(photos / "noise.png"), noise)
    out = tmp_path / "out"
    finished = run("reconstruct", photos, out, "--quiet", "--set", "pairs.mode=exhaustive")
    assert (finished.code, finished.err) == (0, "")
    assert f"report: {out / 'report.html'}" in finished.out
    (line,) = caplog.messages
    assert line.startswith("1 not in the model, too few good matches: noise.png (") and "try photos taken" in line
    summary = json.loads((out / "summary.json").read_text())
    assert list(summary["unregistered"]) == ["noise.png"]
    assert summary["unregistered"]["noise.png"].startswith("too few good matches: ")
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "1 image: too few good matches" in page and "<code>noise.png</code>" in page


def test_without_a_model_there_is_a_report(scene, tmp_path, run, caplog):
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in ("a.jpg", "b.jpg"):
        shutil.copy(scene.images / "view_00.jpg", photos / name)
    finished = run("reconstruct", photos, tmp_path / "out", "--quiet")
    assert finished.code == 3
    (line,) = caplog.messages
    assert line.startswith("2 not in the model, cameras too close to each other: a.jpg (rays meet at ")
    assert "There is no model" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def test_a_report_of_100_images_is_small_and_can_be_turned_and_sorted(large_report, tmp_path, visit):
    page = tmp_path / "report.html"
    text = render_page(large_report)
    assert len(text.encode()) < 20_000_000
    text = text.replace("</head>", f"{AT_ONCE}</head>").replace("</body>", f"{VISITOR}</body>")
    page.write_text(text, encoding="utf-8")
    seen = visit(page)
    assert seen.console == []
    assert seen.point_pixels > 50_000
    visit = json.loads(html.unescape(re.search(r'data-visit="(.*?)"', seen.dom).group(1)))
    assert visit["changed"] == {
        "nothing": False, "turn": True, "move": True, "zoom": True, "pinch": True, "key": True, "cameras": True,
        "reset": False,
    }  # fmt: skip
    name = "folder {}/<IMG>_{}.jpg".format
    assert visit["rows"] == [name(0, 0), name(0, 99), name(0, 0), name(0, 0)]


def test_without_a_model_the_page_has_no_errors(large_report, tmp_path, visit):
    page = tmp_path / "report.html"
    page.write_text(render_page(dataclasses.replace(large_report, scene=None)), encoding="utf-8")
    seen = visit(page)
    assert seen.console == []
    assert "<canvas" not in seen.dom and "<button" in seen.dom


def test_an_error_of_a_script_would_be_noticed(tmp_path, visit):
    page = tmp_path / "broken.html"
    page.write_text("<!DOCTYPE html><script>undefinedFunction()</script>")
    (line,) = visit(page).console
    assert "undefinedFunction" in line
