"""The page of a report: what it holds, and that no name can break it."""

import base64
import dataclasses
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from hm_sfm.config import Config
from hm_sfm.report.diagnosis import Cause, Diagnosis
from hm_sfm.report.gather import ImageMetrics, RefutedPair, Report, Scene, WeakPair
from hm_sfm.report.page import LABEL_LENGTH, MOST_PAIRS, render_page, write_report
from hm_sfm.types import ImagePair

EVIL = "a</script><b onclick='x'>&\"é .jpg"
VOID = {"meta", "link", "img", "input"}


class Balance(HTMLParser):
    """Fails where tags are not closed in the order in which they were opened."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[str] = []
        self.text = ""

    def handle_starttag(self, tag, attrs):
        self.seen.append(tag)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.seen.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def make_report(names=("a.jpg", "b.jpg", "c.jpg")) -> Report:
    """Three images, the last of which is not registered."""
    images = [
        ImageMetrics(
            name=name, registered=True, keypoints=1200, observations=900, mean_error_px=0.25, neighbours=1, reason=""
        )
        for name in names
    ]
    images[-1] = dataclasses.replace(
        images[-1], registered=False, observations=0, mean_error_px=None, neighbours=0, reason="at most 3, with a.jpg"
    )
    seconds = {"features": 1.0, "match": 6.0, "keypoints": 1.0, "verify": 1.0, "map": 0.5, "total": 10.0}
    summary = {
        "num_images": 3, "skipped_images": 1, "registered": 2, "models": 2, "points": 4321, "mean_track_length": 3.456,
        "mean_reprojection_px": 0.4567, "seconds": seconds, "version": "1.2.3", "config_fingerprint": "0123abcd",
    }  # fmt: skip
    rng = np.random.default_rng(0)
    reasons = {names[-1]: "at most 3, with a.jpg"}
    return Report(
        title="castle",
        summary=summary,
        images=tuple(images),
        num_pairs=3,
        verified_pairs={(0, 1): 400},
        scene=Scene(rng.normal(size=(50, 3)), rng.integers(0, 255, (50, 3)), rng.normal(size=(2, 5, 3)), names[:2]),
        track_lengths={"this run": {2: 100, 4: 300}, "loftr_style_raw": {2: 50, 3: 50}},
        weak_pairs=(WeakPair(ImagePair(*sorted(names[:2])), 400, b"jpeg"),),
        refuted_pairs=(
            RefutedPair(ImagePair("a", "c"), 77, 0.25, b"refuted"),
            RefutedPair(ImagePair("<b>", "c"), 55, 0.125, b""),
        ),
        diagnoses=(Diagnosis(Cause.FEW_MATCHES, reasons, ("--pairs exhaustive",)),),
        config=Config(),
    )


def parse(page: str) -> Balance:
    parser = Balance()
    parser.feed(page)
    parser.close()
    assert parser.open == []
    return parser


def test_every_section_shows_its_figures():
    text = parse(render_page(make_report())).text
    for number in ("2 / 3", "4,321", "3.46", "0.457 px", "1 / 3", "1.2.3", "0123abcd"):
        assert number in text
    assert "too few good matches" in text and "at most 3, with a.jpg" in text and "--pairs exhaustive" in text
    assert "this run, mean 3.50" in text and "loftr_style_raw, mean 2.50" in text
    assert "a.jpg – b.jpg: 400 matches" in text
    assert re.search(r"matching\s*6\.0 s", text) and re.search(r"everything else\s*0\.5 s", text)
    assert "long_edge_px: 1024" in text
    assert "largest of 2 models" in text


def test_pairs_that_were_given_up_are_shown_or_named():
    page = render_page(make_report())
    text = parse(page).text
    assert re.search(r"2\s*pairs given up", text)
    assert "a – c: 77 matches, believed to 25 %" in text and "<b> – c: 55 matches, believed to 12 %" in text
    assert page.count(base64.b64encode(b"refuted").decode()) == 1


def test_data_of_the_view_comes_back_bit_for_bit():
    report = make_report()
    (text,) = re.findall(r'<script type="application/json" id="scene-data">(.*?)</script>', render_page(report))
    data = json.loads(text)
    assert data["names"] == ["a.jpg", "b.jpg"]
    for field, dtype, expected in (
        ("points", "<f4", report.scene.xyz),
        ("colours", "u1", report.scene.rgb),
        ("frusta", "<f4", report.scene.frusta),
    ):
        actual = np.frombuffer(base64.b64decode(data[field]), dtype).reshape(expected.shape)
        np.testing.assert_array_equal(actual, expected)


def test_names_cannot_break_the_page():
    report = dataclasses.replace(make_report((EVIL, EVIL + "2", EVIL + "3")), title=EVIL)
    page = render_page(report)
    parsed = parse(page)
    assert parsed.seen.count("script") == 2
    assert parsed.seen.count("b") == parse(render_page(make_report())).seen.count("b")
    assert EVIL in parsed.text
    assert "<b onclick" not in page


def test_a_page_refers_to_nothing_outside():
    page = render_page(make_report())
    assert not re.search(r"https?:|src=\"(?!data:)|href=\"(?!data:)|@import|url\(", page)
    assert "default-src 'none'" in page


def test_without_a_model_the_page_says_so():
    """No model, no verified pair, no tracks."""
    report = make_report()
    images = [dataclasses.replace(image, registered=False, mean_error_px=None) for image in report.images]
    summary = {**report.summary, "registered": 0, "models": 0, "points": 0}
    nothing = {
        "verified_pairs": {},
        "scene": None,
        "track_lengths": {"this run": {}},
        "weak_pairs": (),
        "refuted_pairs": (),
    }
    empty = dataclasses.replace(report, summary=summary, images=tuple(images), **nothing)
    text = parse(render_page(empty)).text
    for phrase in ("There is no model", "There are no tracks", "No pair was verified", "0 verified pairs"):
        assert phrase in text
    assert "<canvas" not in render_page(empty)
    assert "given up" not in text


def test_baseline_alone_has_tracks():
    page = render_page(dataclasses.replace(make_report(), track_lengths={"this run": {}, "loftr_style_raw": {3: 7}}))
    assert 'class="bar"' not in page and "polyline" in page


def test_all_images_registered_leave_no_warning():
    assert "Not in the model" not in render_page(dataclasses.replace(make_report(), diagnoses=()))


@pytest.mark.parametrize("count", [20, 120])
def test_large_graphs_draw_their_strongest_pairs_and_no_names(count):
    image = make_report().images[0]
    images = [dataclasses.replace(image, name=f"some/long/folder/view_{i:03d}.jpg") for i in range(count)]
    verified_pairs = {(i, j): 1 + i * count + j for i in range(count) for j in range(i + 1, count)}
    page = render_page(dataclasses.replace(make_report(), images=tuple(images), verified_pairs=verified_pairs))
    graph = re.search(r'<svg class="graph".*?</svg>', page, re.DOTALL).group()
    assert graph.count("<line ") == min(len(verified_pairs), MOST_PAIRS)
    assert graph.count("<circle ") == count
    labels = re.findall(r"<text .*?>(.*?)</text>", graph)
    assert len(labels) == (count if count == 20 else 0)
    assert all(len(label) == LABEL_LENGTH for label in labels)
    assert ("weakest are left out" in page) == (len(verified_pairs) > MOST_PAIRS)


def test_the_file_appears_whole(tmp_path):
    write_report(tmp_path / "report.html", make_report())
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == render_page(make_report())
