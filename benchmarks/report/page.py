"""report.html: one page without anything from outside it, with a before/after slider per frame.

Pictures stand in the page once each, as JPEG data URIs in one script; the sliders are plain range inputs, so they work
by keyboard; colours follow the reader's light or dark setting.
"""

# Packages of requirements/bench.txt may be absent; each use says what to do then.
# pyright: reportMissingImports=false

from __future__ import annotations

import base64
import html
import importlib
import io
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .metrics import WHOLE
from .plots import THEMES
from .records import DELIVERED, RunRecord
from .setting import Setting
from .tables import REGION_NAMES, Table
from .truth import RIGID

_JPEG_QUALITY = 92
_SHOWN = 8
"""Sliders per run."""

_STYLE = """
:root { color-scheme: light dark; --ink: #1d1d1f; --quiet: #5c5c66; --ground: #ffffff; --card: #f4f4f6;
  --line: #d5d5da; --accent: #b3145a; --win: #14703c; --loss: #a3330b; }
@media (prefers-color-scheme: dark) { :root { --ink: #e9e9ec; --quiet: #a6a6b0; --ground: #1b1b1f; --card: #26262b;
  --line: #45454c; --accent: #ff7fb0; --win: #6fd39a; --loss: #ff9a70; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 76rem; padding: 1.5rem 1.25rem 4rem; background: var(--ground); color: var(--ink);
  font: 15px/1.5 system-ui, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
h1 { font-size: 1.6rem; line-height: 1.2; margin: 0 0 .25rem; }
h2 { font-size: 1.2rem; margin: 2.5rem 0 .5rem; }
h3 { font-size: 1rem; margin: 1.5rem 0 .4rem; }
p, ul { max-width: 50rem; } .quiet { color: var(--quiet); font-size: .9rem; }
code { font: .85em ui-monospace, "DejaVu Sans Mono", monospace; overflow-wrap: anywhere; }
nav { display: flex; flex-wrap: wrap; gap: .25rem 1rem; margin: 1rem 0; }
a { color: var(--accent); }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .87rem; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .65rem; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap; }
th { color: var(--quiet); font-weight: 600; vertical-align: bottom; white-space: normal; min-width: 4rem; }
th:first-child, td:first-child, .word { text-align: left; }
td:first-child { white-space: normal; min-width: 11rem; max-width: 22rem; }
tr.best td { font-weight: 700; } tr.win td:last-child { color: var(--win); font-weight: 600; }
tr.loss td:last-child { color: var(--loss); font-weight: 600; }
figure { margin: 1rem 0; } figure img { max-width: 100%; height: auto; border-radius: 4px; }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(30rem, 100%), 1fr)); gap: 1rem; }
.plots figure { margin: 0; }
details { border: 1px solid var(--line); border-radius: 6px; margin: .6rem 0; }
summary { cursor: pointer; padding: .5rem .8rem; font-weight: 600; }
.frames { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(22rem, 100%), 1fr)); gap: 1rem;
  padding: 0 .8rem .8rem; }
.frame { background: var(--card); border-radius: 6px; padding: .5rem; }
.pair { position: relative; --cut: 50%; }
.pair img { display: block; width: 100%; height: auto; border-radius: 3px; background: var(--line); }
.pair .ours { position: absolute; inset: 0; clip-path: inset(0 0 0 var(--cut)); }
.pair i { position: absolute; top: 0; bottom: 0; left: var(--cut); width: 2px; margin-left: -1px; background: #fff;
  box-shadow: 0 0 2px #000; }
.pair b { position: absolute; bottom: .4rem; padding: 0 .4rem; border-radius: 3px; background: rgb(0 0 0 / .65);
  color: #fff; font-size: .75rem; font-weight: 500; }
.pair .left { left: .4rem; } .pair .right { right: .4rem; }
input[type=range] { width: 100%; margin: .4rem 0 0; accent-color: var(--accent); }
:focus-visible { outline: 2px solid var(--accent); outline-offset: 2px; }
"""

_SCRIPT = """
const pictures = JSON.parse(document.getElementById("pictures").textContent);
for (const image of document.querySelectorAll("img[data-picture]")) image.src = pictures[image.dataset.picture];
for (const slider of document.querySelectorAll(".frame input")) {
  const pair = slider.previousElementSibling;
  const move = () => {
    pair.style.setProperty("--cut", slider.value + "%");
    slider.setAttribute("aria-valuetext", slider.value + " % truth");
  };
  slider.addEventListener("input", move);
  pair.addEventListener("pointerdown", (down) => {
    const follow = (event) => {
      const box = pair.getBoundingClientRect();
      slider.value = Math.max(0, Math.min(100, Math.round(100 * (event.clientX - box.left) / box.width)));
      move();
    };
    pair.setPointerCapture(down.pointerId);
    follow(down);
    pair.addEventListener("pointermove", follow);
    pair.addEventListener("pointerup", () => pair.removeEventListener("pointermove", follow), { once: true });
    pair.addEventListener("pointercancel", () => pair.removeEventListener("pointermove", follow), { once: true });
  });
  move();
}
"""


def page(
    title: str,
    facts: Sequence[str],
    missing: Sequence[str],
    tables: Sequence[Table],
    plots: Sequence[tuple[str, Path, Path]],
    figures: Sequence[tuple[str, Path]],
    settings: Sequence[Setting],
    results: Path,
) -> str:
    """The page as text.

    Args:
        title: its heading.
        facts: machine, date, command: one line each.
        said: sentences about what is missing.
        plots: (description, light PNG, dark PNG).
        figures: (description, PNG).
        settings: whose runs get sliders.
        results: folder that the records' pictures are relative to.
    """
    pictures: dict[str, str] = {}
    parts = [f"<h1>{html.escape(title)}</h1>"]
    parts += [f'<p class="quiet">{"<br>".join(facts)}</p>']
    links = [("tables", "Tables")] + [("plots", "Speed against error")] * bool(plots)
    links += [("figures", "Figures")] * bool(figures) + [("frames", "Frames")]
    parts += ["<nav>" + "".join(f'<a href="#{at}">{name}</a>' for at, name in links) + "</nav>"]
    if missing:
        parts += ["<h2>What is missing</h2><ul>" + "".join(f"<li>{html.escape(s)}</li>" for s in missing) + "</ul>"]
    parts += ['<h2 id="tables">Tables</h2>', *(_table(table) for table in tables)]
    if plots:
        parts += ['<h2 id="plots">Speed against error</h2><div class="plots">', *(_plot(*p) for p in plots), "</div>"]
    if figures:
        parts += ['<h2 id="figures">Figures</h2>', *(_figure(name, path) for name, path in figures)]
    parts += ['<h2 id="frames">Frames, worst first</h2>']
    parts += ['<p class="quiet">Truth on the left, ours on the right: drag, or use the arrow keys on the slider.</p>']
    parts += _sliders(settings, results, pictures)
    data = json.dumps(pictures).replace("</", "<\\/")
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
        "style-src 'unsafe-inline'; script-src 'unsafe-inline'\">"
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head>\n<body>\n"
        + "\n".join(parts)
        + f'\n<script type="application/json" id="pictures">{data}</script>\n<script>{_SCRIPT}</script>\n'
        + "</body></html>\n"
    )


def _table(table: Table) -> str:
    words = [bool(_word(table.rows[0][i])) if table.rows else False for i in range(len(table.header))]
    head = "".join(
        f'<th scope="col"{" class=word" * word}>{html.escape(name)}</th>'
        for name, word in zip(table.header, words, strict=True)
    )
    rows: list[str] = []
    for i, row in enumerate(table.rows):
        mark = f' class="{table.marks[i]}"' if i in table.marks else ""
        cells = "".join(f"<td{_word(cell)}>{html.escape(cell)}</td>" for cell in row)
        rows.append(f"<tr{mark}>{cells}</tr>")
    note = f'<p class="quiet">{html.escape(table.note)}</p>' if table.note else ""
    return (
        f'<h3>{html.escape(table.title)}</h3><div class="scroll" tabindex="0" role="region" '
        f'aria-label="{html.escape(table.title)}"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>{note}"
    )


def _word(cell: str) -> str:
    """Attribute of a cell that is text, not a figure with its unit: "4DGaussians" is, "3 frames" is not."""
    text = re.match(r"\d*[^\W\d]", cell) and cell not in ("win", "loss", "undecided")
    return ' class="word"' if text else ""


def _plot(name: str, light: Path, dark: Path) -> str:
    sources = {theme: _uri(path.read_bytes(), "png") for theme, path in zip(THEMES, (light, dark), strict=True)}
    return (
        f'<figure><picture><source media="(prefers-color-scheme: dark)" srcset="{sources["dark"]}">'
        f'<img src="{sources["light"]}" alt="{html.escape(name)}"></picture></figure>'
    )


def _figure(name: str, path: Path) -> str:
    data = path.read_bytes()
    width = int.from_bytes(data[16:20], "big")  # of a PNG's header
    style = f'style="width: {round(width / 1.7)}px"'
    return f'<figure><img src="{_uri(data, "png")}" alt="{html.escape(name)}" loading="lazy" {style}></figure>'


def _sliders(settings: Sequence[Setting], results: Path, pictures: dict[str, str]) -> list[str]:
    """One folded box per run, the first of each scene open."""
    by_scene: dict[str, list[tuple[str, RunRecord]]] = {}
    for setting in settings:
        for run in setting.runs:
            if run.pictures:
                by_scene.setdefault(run.scene, []).append((setting.label, run))
    parts: list[str] = []
    for scene, runs in by_scene.items():
        parts.append(f"<h3>{html.escape(scene)}</h3>")
        # What the product does by default comes first.
        for n, (label, run) in enumerate(sorted(runs, key=lambda r: _rank(r[1]))):
            frames = "".join(_slider(run, i, results, pictures) for i in range(min(_SHOWN, len(run.pictures))))
            name = f"{label}, seed {run.seed}" if run.seed else label
            opened = " open" if n == 0 else ""
            parts.append(
                f'<details{opened}><summary>{html.escape(name)}</summary><div class="frames">{frames}</div></details>'
            )
    return parts


def _rank(run: RunRecord) -> tuple[bool, bool, bool]:
    return run.host != "auto", run.variant != "default", run.shown != DELIVERED


def _slider(run: RunRecord, index: int, results: Path, pictures: dict[str, str]) -> str:
    shown = run.pictures[index]
    for path in (shown.truth, shown.ours):
        if path not in pictures:
            pictures[path] = _jpeg(results / path)
    where = REGION_NAMES[RIGID if run.kind == "real" else WHOLE]
    name = f"t* {shown.t_star}, pose {shown.pose}: {shown.psnr_db:.2f} dB, {where}"
    height = round(100 * run.height / run.width, 2)
    size = f'style="aspect-ratio: 100 / {height}"'
    return (
        f'<div class="frame"><div class="pair"><img data-picture="{html.escape(shown.truth)}" alt="truth" {size}>'
        f'<img class="ours" data-picture="{html.escape(shown.ours)}" alt="ours" {size}><i></i>'
        '<b class="left">truth</b><b class="right">ours</b></div>'
        f'<input type="range" min="0" max="100" value="50" aria-label="Share of truth shown, {html.escape(name)}">'
        f'<div class="quiet">{html.escape(name)}</div></div>'
    )


def _jpeg(path: Path) -> str:
    """A picture as JPEG data URI."""
    Image: Any = importlib.import_module("PIL.Image")  # of requirements/bench.txt

    stream = io.BytesIO()
    with Image.open(path) as picture:
        picture.convert("RGB").save(stream, "JPEG", quality=_JPEG_QUALITY, subsampling=0)
    return _uri(stream.getvalue(), "jpeg")


def _uri(data: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
