"""OUT/report.html: what hm_sfm.report.gather gathers, as one page that needs nothing else to open."""

import base64
import dataclasses
import json
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template

import numpy as np
import yaml

from hm_sfm.io.atomic import replace_file
from hm_sfm.report.gather import ImageMetrics, RefutedPair, Report, Scene, WeakPair
from hm_sfm.types import ImagePair

MOST_PAIRS = 4000
"""Strongest verified pairs that the graph draws."""
MOST_LABELS = 48
"""With more images than this, the graph names them only under the pointer."""
LABEL_LENGTH = 20
RING = 240
"""Radius of the graph's ring of images; its picture reaches from -GRAPH_HALF to GRAPH_HALF."""
GRAPH_HALF = 370
PLOT_WH = (760, 250)
PLOT_LEFT, PLOT_BOTTOM, PLOT_TOP = 44, 24, 12
STAGES = {
    "features": "features of the photos",
    "match": "matching",
    "keypoints": "keypoints and tracks",
    "verify": "verification",
    "judge": "judgement of pairs",
    "map": "mapping",
}


def write_report(path: Path, report: Report) -> None:
    """Write the page, atomically."""
    page = render_page(report)
    with replace_file(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def render_page(report: Report) -> str:
    """The page: HTML with its style, script, pictures and data inside."""
    summary = report.summary
    seconds = f"{summary['seconds']['total']:.0f}"
    folder = files("hm_sfm.report") / "templates"
    return Template((folder / "report.html").read_text(encoding="utf-8")).substitute(
        title=escape(report.title),
        subtitle=escape(f"hm_sfm {summary['version']}, configuration {summary['config_fingerprint']}, {seconds} s"),
        style=(folder / "report.css").read_text(encoding="utf-8"),
        script=(folder / "report.js").read_text(encoding="utf-8"),
        tiles=render_tiles(report),
        diagnoses=render_diagnoses(report),
        scene=render_scene(report.scene, summary["models"]),
        images=render_images(report.images),
        track_lengths=render_track_lengths(report.track_lengths),
        graph=render_graph(report.images, report.verified_pairs),
        weak_pairs=render_weak_pairs(report.weak_pairs),
        refuted_pairs=render_refuted_pairs(report.refuted_pairs),
        timings=render_timings(summary["seconds"]),
        config=escape(yaml.safe_dump(dataclasses.asdict(report.config), sort_keys=False)),
    )


def render_tiles(report: Report) -> str:
    """The numbers at the top."""
    summary = report.summary
    tiles = [
        (f"{summary['registered']} / {summary['num_images']}", "images registered"),
        (f"{summary['points']:,}", "points"),
        (f"{summary['mean_track_length']:.2f}", "images per track"),
        (f"{summary['mean_reprojection_px']:.3f} px", "reprojection error"),
        (f"{len(report.verified_pairs):,} / {report.num_pairs:,}", "pairs verified"),
    ]
    if report.refuted_pairs:
        tiles.append((f"{len(report.refuted_pairs):,}", "pairs given up"))
    if summary["models"] > 1:
        tiles.append((str(summary["models"]), "models"))
    if summary["skipped_images"]:
        tiles.append((str(summary["skipped_images"]), "files skipped"))
    return "".join(f"<div><b>{escape(value)}</b><span>{escape(label)}</span></div>" for value, label in tiles)


def render_diagnoses(report: Report) -> str:
    """What kept images out of the model; nothing where none was."""
    if not report.diagnoses:
        return ""
    items = []
    for diagnosis in report.diagnoses:
        names = "".join(
            f"<li><code>{escape(name)}</code> {escape(reason)}</li>" for name, reason in diagnosis.reasons.items()
        )
        advice = f"<p>Try {escape(', or '.join(diagnosis.advice))}.</p>" if diagnosis.advice else ""
        count = len(diagnosis.reasons)
        title = f"{count} {'image' if count == 1 else 'images'}: {diagnosis.cause.value}"
        items.append(f"<details open><summary>{escape(title)}</summary>{advice}<ul>{names}</ul></details>")
    return f'<section class="warning"><h2>Not in the model</h2>{"".join(items)}</section>'


def render_scene(scene: Scene | None, num_models: int) -> str:
    """The canvas, its controls and the data that the script shows in it."""
    if scene is None:
        return "<p>There is no model: no pair of photos gave one to start from.</p>"
    data = {
        "points": encode(scene.xyz),
        "colours": encode(scene.rgb),
        "frusta": encode(scene.frusta),
        "names": scene.names,
    }
    more = f" This is the largest of {num_models} models." if num_models > 1 else ""
    # Inside a script element, only "<" could end it or open a comment.
    text = json.dumps(data).replace("<", "\\u003c")
    return f"""<canvas id="scene" tabindex="0" role="img" aria-label="points and cameras of the model"></canvas>
<div class="controls"><label><input type="checkbox" id="show-cameras" checked> cameras</label>
<label>point size <input type="range" id="point-size" min="1" max="6" value="2"></label>
<button id="reset-view" type="button">reset view</button><span id="camera-name"></span></div>
<p class="note">Drag to turn, wheel or pinch to zoom, Shift or the right button or two fingers to move.
{len(scene.xyz):,} points, {len(scene.names):,} cameras.{more}</p>
<noscript><p>The 3D view needs JavaScript; everything else on this page does not.</p></noscript>
<script type="application/json" id="scene-data">{text}</script>"""


def encode(array: np.ndarray) -> str:
    """Base64 of the array's bytes, little-endian."""
    return base64.b64encode(array.astype(array.dtype.newbyteorder("<")).tobytes()).decode()


def render_images(images: Sequence[ImageMetrics]) -> str:
    """The rows of the table of images."""
    rows = []
    for image in images:
        state = "yes" if image.registered else "no"
        cells = [
            f'<td data-value="{int(image.registered)}" class="{state}" title="{escape(image.reason)}">{state}</td>',
            render_number(image.keypoints),
            render_number(image.observations),
            render_number(image.mean_error_px, ".3f"),
            render_number(image.neighbours),
        ]
        rows.append(f'<tr><th scope="row">{escape(image.name)}</th>{"".join(cells)}</tr>')
    return "\n".join(rows)


def render_number(value: float | None, form: str = ",") -> str:
    """A cell of a table; a dash, which sorts first, where there is no value."""
    if value is None:
        return '<td data-value="-1">&ndash;</td>'
    return f'<td data-value="{value:.6g}">{value:{form}}</td>'


def render_track_lengths(histograms: Mapping[str, Mapping[int, int]]) -> str:
    """The share of the points with each track length: bars of the first method, lines of the others."""
    names = [name for name, histogram in histograms.items() if histogram]
    if not names:
        return "<p>There are no tracks.</p>"
    lengths = range(2, max(max(histograms[name]) for name in names) + 1)
    shares = {
        name: [100 * histograms[name].get(n, 0) / sum(histograms[name].values()) for n in lengths] for name in names
    }
    width, height = PLOT_WH
    top = max(max(share) for share in shares.values())
    step = (width - PLOT_LEFT) / len(lengths)

    def place(share: float) -> float:
        return height - PLOT_BOTTOM - share / top * (height - PLOT_BOTTOM - PLOT_TOP)

    parts = []
    for share in (0, top / 2, top):
        y = place(share)
        parts.append(f'<line class="grid" x1="{PLOT_LEFT}" x2="{width}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text x="{PLOT_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{share:.0f} %</text>')
    every = -(-len(lengths) // 20)
    for number, n in enumerate(lengths):
        if number % every == 0:
            x = PLOT_LEFT + (number + 0.5) * step
            parts.append(f'<text x="{x:.1f}" y="{height - 7}" text-anchor="middle">{n}</text>')
    first, *others = names
    if first == next(iter(histograms)):
        for number, (n, share) in enumerate(zip(lengths, shares[first])):
            x, y = PLOT_LEFT + (number + 0.15) * step, place(share)
            hint = f"{n} images: {histograms[first].get(n, 0):,} points, {share:.1f} %"
            parts.append(
                f'<rect class="bar" x="{x:.1f}" y="{y:.1f}" width="{0.7 * step:.1f}" height="{place(0) - y:.1f}">'
                f"<title>{hint}</title></rect>"
            )
    else:
        others = names
    for number, name in enumerate(others):
        points = " ".join(
            f"{PLOT_LEFT + (column + 0.5) * step:.1f},{place(share):.1f}" for column, share in enumerate(shares[name])
        )
        parts.append(f'<polyline class="baseline b{number}" points="{points}"/>')
    legend = "".join(
        f'<span class="{"bar" if name not in others else f"baseline b{others.index(name)}"}">{escape(name)}, mean '
        f"{sum(n * points for n, points in histograms[name].items()) / sum(histograms[name].values()):.2f}</span>"
        for name in names
    )
    label = 'role="img" aria-label="histogram of track lengths"'
    return f"""<svg viewBox="0 0 {width} {height}" {label}>{"".join(parts)}</svg>
<p class="legend">{legend}</p>"""


def render_graph(images: Sequence[ImageMetrics], verified_pairs: Mapping[tuple[int, int], int]) -> str:
    """The images on a ring, in the order of their names; lines are the stronger the more matches a pair has."""
    angle = 2 * np.pi * np.arange(len(images)) / max(1, len(images)) - np.pi / 2
    x, y = RING * np.cos(angle), RING * np.sin(angle)
    strongest = sorted(verified_pairs.items(), key=lambda item: -item[1])[:MOST_PAIRS]
    most = max((count for _, count in strongest), default=1)
    parts = []
    for (first, second), count in reversed(strongest):
        strength = (count / most) ** 0.5
        parts.append(
            f'<line x1="{x[first]:.1f}" y1="{y[first]:.1f}" x2="{x[second]:.1f}" y2="{y[second]:.1f}" '
            f'stroke-opacity="{0.06 + 0.7 * strength:.2f}" stroke-width="{0.4 + 2.2 * strength:.1f}"/>'
        )
    degree = np.bincount(np.array(list(verified_pairs), np.int64).reshape(-1), minlength=len(images))
    for number, image in enumerate(images):
        hint = f"{image.name}: {degree[number]} verified pairs" + ("" if image.registered else f", {image.reason}")
        state = "yes" if image.registered else "no"
        parts.append(
            f'<circle class="{state}" cx="{x[number]:.1f}" cy="{y[number]:.1f}" r="5"><title>{escape(hint)}</title>'
            "</circle>"
        )
        if len(images) <= MOST_LABELS:
            is_left = np.cos(angle[number]) < -1e-9
            angle_deg = np.degrees(angle[number]) + (180 if is_left else 0)
            at, anchor = (-(RING + 12), "end") if is_left else (RING + 12, "start")
            name = image.name if len(image.name) <= LABEL_LENGTH else "\u2026" + image.name[1 - LABEL_LENGTH :]
            parts.append(
                f'<text transform="rotate({angle_deg:.1f})" x="{at}" y="4" text-anchor="{anchor}">{escape(name)}</text>'
            )
    left_out = len(verified_pairs) - len(strongest)
    note = f" The {left_out:,} weakest are left out." if left_out else ""
    size = 2 * GRAPH_HALF
    return f"""<svg class="graph" viewBox="{-GRAPH_HALF} {-GRAPH_HALF} {size} {size}" role="img"
aria-label="graph of the verified pairs">{"".join(parts)}</svg>
<p class="note">{len(verified_pairs):,} verified pairs; the strongest has {max(verified_pairs.values(), default=0):,}
matches.{note}</p>"""


def render_weak_pairs(weak_pairs: Sequence[WeakPair]) -> str:
    """Pictures of the weakest pairs."""
    if not weak_pairs:
        return "<p>No pair was verified.</p>"
    return "".join(render_pair(weak.pair, weak.jpeg, f"{weak.matches:,} matches") for weak in weak_pairs)


def render_refuted_pairs(refuted_pairs: Sequence[RefutedPair]) -> str:
    """The section of the pairs that were given up; nothing where there are none."""
    if not refuted_pairs:
        return ""
    texts = [f"{refuted.matches:,} matches, believed to {100 * refuted.belief:.0f} %" for refuted in refuted_pairs]
    shown = "".join(
        render_pair(refuted.pair, refuted.jpeg, text) for refuted, text in zip(refuted_pairs, texts) if refuted.jpeg
    )
    others = "".join(
        f"<li>{name_pair(refuted.pair)}: {text}</li>" for refuted, text in zip(refuted_pairs, texts) if not refuted.jpeg
    )
    rest = f"<details><summary>All others</summary><ul>{others}</ul></details>" if others else ""
    return f"""<section id="refuted"><h2>Pairs given up</h2>
<p class="note">Their matches agree with each other, but not with those of other photos: going from photo to photo in a
circle does not lead back to where it began. Mostly they show two places that look alike, such as the windows of two
facades. Those with the most matches:</p>
<div class="pairs">{shown}</div>{rest}</section>"""


def render_pair(pair: ImagePair, jpeg: bytes, text: str) -> str:
    """A picture of a pair's matches, with its names and `text` below."""
    picture = f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode()}"
    return (
        f'<figure><img src="{picture}" alt="matches of {name_pair(pair)}" loading="lazy">'
        f"<figcaption>{name_pair(pair)}: {text}</figcaption></figure>"
    )


def name_pair(pair: ImagePair) -> str:
    """Both names, as HTML."""
    return f"{escape(pair.name0)} &ndash; {escape(pair.name1)}"


def render_timings(seconds: Mapping[str, float]) -> str:
    """The rows of the table of timings."""
    spent = {name: seconds[stage] for stage, name in STAGES.items() if stage in seconds}
    total = max(seconds["total"], sum(spent.values()), 1e-9)
    rows = [*spent.items(), ("everything else", total - sum(spent.values()))]
    return "".join(
        f'<tr><th scope="row">{name}</th><td>{value:,.1f} s</td>'
        f'<td class="share"><i style="width:{100 * value / total:.1f}%"></i></td></tr>'
        for name, value in rows
    )
