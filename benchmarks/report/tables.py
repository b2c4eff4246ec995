"""Turns records into tables: means as in the paper, regions, costs, paired comparisons, ablations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from .hard_table import MOVER_HEADER, MOVER_NOTE, PANE_HEADER, PANE_NOTE, mover_rows, pane_rows
from .metrics import WHOLE, Paired
from .records import DELIVERED, DEVELOPED, SPLATS, WITHHELD, RunRecord
from .setting import NONE, Setting, plain
from .truth import REGIONS, RIGID

HOST_NAMES = {
    "hexplane": "4DGaussians",
    "mlp": "Deformable 3DGS",
    "control_points": "SC-GS",
    "auto": "auto (ours)",
    "static": "static 3DGS",
}
"""TrainConfig.method -> displayed name."""
METRIC_NAMES = {"psnr_db": "PSNR, dB", "ssim": "SSIM", "st_lpips": "ST-LPIPS", "flip": "FLIP", "jod": "JOD"}
REGION_NAMES = {
    WHOLE: "whole frame",
    "seen": "seen at t*",
    "never_seen": "never seen at t*",
    "moving": "moving",
    "static": "static",
    RIGID: "never moves",
}
SHOWN_NAMES = {DEVELOPED: "developed", WITHHELD: "plate detail, plate withheld", DELIVERED: "plate detail"}
"""Variant of a frame, except Gaussians alone -> suffix of the method's name."""
QUERIES = {"plain": "at t*", "nearest": "nearest seen"}
"""Time query of the Gaussians -> text in a table."""
QUERY_NOTE = (
    "Hosts without anchors, or with the paper's anchors, are frozen at t* itself, as published. With `support`, each "
    "Gaussian is evaluated at the time nearest to t* at which it was seen."
)
DETAIL_NOTE = (
    "A method's name without suffix: only Gaussians, as trained. *Developed*: the Gaussians are fine-tuned at t* as a "
    "static scene. *Plate detail*: frames as a take delivers them, with pixels of the plates warped to t* where they "
    "are consistent with the developed instant. *Plate withheld*: the same, without the plate of the judged pose, "
    "which equals the truth wherever nothing moves. The delivered frame at the pose of t* equals the truth and is not "
    "counted."
)
_DIGITS = {"psnr_db": 2, "ssim": 4, "st_lpips": 4, "flip": 4, "jod": 2}


@dataclass
class Table:
    """A table of text cells, for Markdown and for report.json."""

    title: str
    header: list[str]
    rows: list[list[str]]
    note: str = ""
    best: int | None = None
    """Index of the bold row, or None."""


def settings_of(records: Sequence[RunRecord], kind: str) -> list[Setting]:
    """The records of synthetic or real scenes grouped by setting, with hosts in the order of `HOST_NAMES`.

    Each variant in `detailed` is a separate setting, after the one of Gaussians alone.
    """
    of_kind = [r for r in records if r.kind == kind]
    chosen = [shown for r in of_kind for shown in (r, *(r.as_shown(name) for name in r.detailed))]
    presets, cameras = {r.preset for r in chosen}, {r.cameras for r in chosen}
    groups: dict[tuple[str, ...], list[RunRecord]] = {}
    for record in chosen:
        groups.setdefault(record.setting, []).append(record)
    hosts, supervisions = list(HOST_NAMES), ["none", "paper", "support"]

    def order(setting: tuple[str, ...]) -> tuple[Any, ...]:
        host, supervision, preset, variant, camera, shown = setting
        at = hosts.index(host) if host in hosts else len(hosts)
        shown_rank = (SPLATS, *SHOWN_NAMES).index(shown)
        return camera, preset, variant != "default", at, supervisions.index(supervision), variant, shown_rank

    found: list[Setting] = []
    for key in sorted(groups, key=order):
        host, supervision, preset, variant, camera, shown = key
        label = _label(host, supervision, variant) + (f", {SHOWN_NAMES[shown]}" if shown != SPLATS else "")
        extra = [preset] * (len(presets) > 1) + [f"{camera} cameras"] * (len(cameras) > 1)
        label += f" ({', '.join(extra)})" if extra else ""
        found.append(Setting(label, host, supervision, preset, variant, camera, shown, groups[key]))
    return found


def _label(host: str, supervision: str, variant: str) -> str:
    name = HOST_NAMES.get(host, host) + (" (reference)" if variant == "reference" else "")
    if supervision != "none" and not (host == "auto" and supervision == "support"):
        name += f" + {supervision}"
    elif supervision == "none" and host == "auto":
        name += ", no anchors"
    return name if variant in ("default", "reference") else f"{name}: {variant}"


# ------------------------------------------------------------------------------------------------- tables


def all_tables(records: Sequence[RunRecord]) -> list[Table]:
    """All tables for which the records have figures."""
    synthetic, real = settings_of(records, "synthetic"), settings_of(records, "real")
    main = [s for s in synthetic if s.variant in ("default", "reference")]
    tables: list[Table] = []
    if main:
        tables += [
            _who_wins(main),
            _quality(main, WHOLE, "Frozen frames against the rendered truth, whole frame"),
            _regions(main),
            _every_metric(main, (WHOLE, "never_seen"), "All metrics, frame by frame"),
        ]
    if rows := pane_rows(main):
        tables.append(Table("Glass and mirrors", PANE_HEADER, rows, PANE_NOTE))
    if rows := mover_rows(main):
        tables.append(Table("Small moving objects and hair", MOVER_HEADER, rows, MOVER_NOTE))
    ablations = [s for s in synthetic if s.variant not in ("default", "reference") and s.shown == SPLATS]
    if ablations:
        tables.append(_ablations(ablations, main))
    if real:
        tables += [
            _quality(real, RIGID, "Real clips: static pixels of frozen frames against held-out plates"),
            _real_extra(real),
            _every_metric(real, (RIGID,), "Real clips: all metrics, frame by frame"),
        ]
    tables += [_costs(s) for s in (main, real) if s]
    return tables


def _quality(settings: Sequence[Setting], region: str, title: str) -> Table:
    header = ["method", "frozen", "runs", "frames", "PSNR mean", "bottom 75 %", "50 %", "25 %", "worst frame"]
    header += ["SSIM", "ST-LPIPS", "FLIP", "JOD"]
    rows, means = list[list[str]](), list[float | None]()
    for s in settings:
        psnr = s.summary("psnr_db", region)
        shares = [psnr.mean, psnr.bottom_75, psnr.bottom_50, psnr.bottom_25, psnr.worst] if psnr else [None] * 5
        more_metrics = [(m, s.summary(m, region)) for m in ("ssim", "st_lpips", "flip")]
        means.append(shares[0])
        rows.append(
            [
                s.label,
                ", ".join(sorted({QUERIES[r.query] for r in s.runs})),
                str(len(s.runs)),
                str(psnr.count if psnr else 0),
                *(number(v, "psnr_db") for v in shares),
                *(number(summary and summary.mean, m) for m, summary in more_metrics),
                number(s.jod(), "jod"),
            ]
        )
    note = (
        "PSNR in dB. Bottom shares are means over the worst frames, as in the paper's tables. SSIM and JOD "
        "(ColorVideoVDP; 10 means no difference): higher is better. ST-LPIPS and FLIP: lower is better. "
        f"{QUERY_NOTE}" + _detail_note(settings)
    )
    return Table(title, header, rows, note, _best(means))


def _regions(settings: Sequence[Setting]) -> Table:
    rows: list[list[str]] = []
    for s in settings:
        found = [s.summary("psnr_db", region) for region in (WHOLE, *REGIONS)]
        rows.append([s.label, *(number(f and f.mean, "psnr_db") for f in found)])
    header = ["method", *(REGION_NAMES[region] for region in (WHOLE, *REGIONS))]
    note = "Mean PSNR in dB over the frames in which the region covers at least 0.2 % of the picture." + _detail_note(
        settings
    )
    return Table("By region", header, rows, note)


def _detail_note(settings: Sequence[Setting]) -> str:
    return f" {DETAIL_NOTE}" if any(s.shown != SPLATS for s in settings) else ""


def _costs(settings: Sequence[Setting]) -> Table:
    header = [
        "method",
        "held-out PSNR, dB",
        "moving",
        "static",
        "training, s",
        "processor, s",
        "threads × runs at once",
    ]
    header += ["steps", "step, ms", "frozen frames / s", "model, MB", "Gaussians", "moving, %"]
    rows: list[list[str]] = []
    for s in settings:
        rows.append(
            [
                s.label,
                number(s.of_runs(lambda r: r.heldout_psnr_db), "psnr_db"),
                *(number(s.of_heldout(region), "psnr_db") for region in ("moving", "static")),
                plain(s.of_runs(lambda r: r.train_seconds), 1),
                plain(s.of_runs(lambda r: r.train_cpu_seconds), 1),
                ", ".join(sorted({pace(r) for r in s.runs})),
                plain(s.of_runs(lambda r: r.iterations), 0),
                plain(s.of_runs(lambda r: r.step_ms), 1),
                plain(s.of_runs(lambda r: r.frozen_fps), 1),
                plain(s.of_runs(lambda r: r.model_bytes / 1e6), 2),
                plain(s.of_runs(lambda r: r.gaussians), 0),
                plain(s.of_runs(lambda r: 100 * r.moving_share), 1),
            ]
        )
    loads = [r.machine.get("load_1min") for s in settings for r in s.runs]
    known = [load for load in loads if load is not None]
    note = (
        "Means over runs. Held-out PSNR: frames of the clip that training left out, rendered at their own times; whole "
        "frame, moving and static pixels. Times are wall time with that number of threads per run and of concurrent "
        "runs. Milliseconds per step are measured in the last third of the run, including evaluations. Rows with "
        "developed instants or plate detail use the same trained run."
    )
    if known:
        note += (
            f" Load average of the machine after the runs: {min(known):.1f} to {max(known):.1f}; it affects wall times."
        )
    kind = "real clips" if settings[0].runs[0].kind == "real" else "synthetic scenes"
    return Table(f"Cost ({kind})", header, rows, note)


def comparisons(settings: Sequence[Setting]) -> list[tuple[Setting, Setting]]:
    """Compared pairs (a, b): hosts with and without anchors; ours and each other host, including static; developed
    instants or plate detail, and Gaussians alone."""
    pairs: list[tuple[Setting, Setting]] = []
    for group in _places(settings):
        at = {(s.variant, s.host, s.supervision): s for s in group if s.shown == SPLATS}
        for variant, host in dict.fromkeys((s.variant, s.host) for s in group):
            for a, b in (("paper", "none"), ("support", "paper"), ("support", "none")):
                if (variant, host, a) in at and (variant, host, b) in at:
                    pairs.append((at[variant, host, a], at[variant, host, b]))
        ours = at.get(("default", "auto", "support"))
        if ours:
            bare = [s for s in at.values() if s.host != "auto" and s.supervision == "none"]
            published = [s for s in at.values() if s.variant == "reference" and s not in bare]
            gateless = [s for s in at.values() if (s.variant, s.host, s.supervision) == (*GATELESS, "support")]
            pairs += [(ours, s) for s in (*bare, *published, *gateless)]
        derived = [s for s in group if s.shown != SPLATS]
        pairs += [(s, at[s.variant, s.host, s.supervision]) for s in derived]
    return pairs


GATELESS = ("default", "hexplane")
"""(variant, host) that equals `auto` without its gate, with all Gaussians moving."""


def _places(settings: Sequence[Setting]) -> list[list[Setting]]:
    """Groups of comparable settings: those with the same cameras and preset."""
    by_place: dict[tuple[str, str], list[Setting]] = {}
    for s in settings:
        by_place.setdefault((s.cameras, s.preset), []).append(s)
    return list(by_place.values())


def _who_wins(settings: Sequence[Setting]) -> Table:
    """Table of all comparisons: mean paired difference, its standard error, and relative cost."""
    header = ["a against b", "region", "cost a / b", "PSNR a - b, dB", "standard error", "n", "frames", "verdict"]
    rows: list[list[str]] = []

    def add(a: Setting, b: Setting, where: str, result: Paired | None, cost: str = "") -> None:
        if result is not None:
            rows.append([f"{a.label} against {b.label}", where, cost, *_paired_cells(result)])

    for a, b in comparisons(settings):
        seconds = _times("training", a.ratio(b, lambda r: r.train_seconds))
        if a.shown != SPLATS:
            for region in (WHOLE, *REGIONS):
                frames = _times("frozen frame", a.ratio(b, _frame_seconds))
                add(a, b, REGION_NAMES[region], a.against(b, "psnr_db", region), frames)
        elif a.host == b.host:
            for region in (WHOLE, "never_seen"):
                add(a, b, REGION_NAMES[region], a.against(b, "psnr_db", region), seconds)
        elif b.host == "static":
            frames = _times("frozen frame", a.ratio(b, _frame_seconds))
            for region in ("static", "seen"):
                add(a, b, REGION_NAMES[region], a.against(b, "psnr_db", region), frames)
            add(a, b, "moving, held-out frames of the clip", a.against_heldout(b, "moving"), seconds)
        elif (b.variant, b.host, b.supervision) == (*GATELESS, "support"):
            step = _times("step", a.ratio(b, lambda r: r.step_ms))
            add(a, b, f"{REGION_NAMES[WHOLE]} (gate on, off)", a.against(b, "psnr_db"), step)
        elif b.variant == "reference":
            add(a, b, REGION_NAMES[WHOLE], a.against(b, "psnr_db"), seconds)
    note = (
        "Win or loss: the mean difference exceeds twice its standard error. Frames of one run are correlated. The "
        "standard error is therefore taken over runs, that is (scene, training seed) pairs, if there are at least "
        "four; else over freezes, that is (run, t*) pairs; else over frames, which underestimates it. With fewer than "
        "four units the verdict is undecided. Costs are geometric means of ratios over runs of the same scene and "
        f"seed. Costs of a step are measured in the last third of a run. {QUERY_NOTE}"
    )
    return Table("Paired comparisons", header, rows, note)


def _frame_seconds(run: RunRecord) -> float | None:
    return 1.0 / run.frozen_fps if run.frozen_fps else None


def _times(what: str, ratio: float | None) -> str:
    return NONE if ratio is None else f"{what} {ratio:.2f}"


def _every_metric(settings: Sequence[Setting], regions: Sequence[str], title: str) -> Table:
    header = ["a against b", "region", *METRIC_NAMES.values(), "n"]
    rows: list[list[str]] = []
    for a, b in comparisons(settings):
        for region in regions:
            whole = region in (WHOLE, RIGID)
            found = {m: a.against(b, m, region) for m in METRIC_NAMES if m != "jod" or whole}
            psnr = found["psnr_db"]
            if psnr is not None:
                cells = [_difference(found.get(m), m) for m in METRIC_NAMES]
                label = f"{a.label} against {b.label}"
                rows.append([label, REGION_NAMES[region], *cells, f"{psnr.units} {psnr.unit}"])
    note = (
        "a - b: mean, standard error, and the verdict unless it is undecided. For ST-LPIPS and FLIP lower is better. "
        "JOD (ColorVideoVDP) is measured on whole frames; each instant is one sequence."
    )
    return Table(title, header, rows, note)


def _difference(result: Paired | None, metric: str) -> str:
    if result is None:
        return NONE
    digits = _DIGITS[metric]
    error = "" if result.se is None else f" ± {result.se:.{digits}f}"
    return f"{result.mean:+.{digits}f}{error}" + (f" {result.verdict}" if result.verdict != "undecided" else "")


def _paired_cells(result: Paired) -> list[str]:
    error = NONE if result.se is None else f"{result.se:.3f}"
    return [f"{result.mean:+.3f}", error, f"{result.units} {result.unit}", str(result.frames), result.verdict]


def _ablations(ablations: Sequence[Setting], main: Sequence[Setting]) -> Table:
    header = ["ablation", "of", "region", "PSNR a - b, dB", "standard error", "independent units", "frames", "verdict"]
    rows: list[list[str]] = []
    for s in ablations:
        splats = [m for m in main if m.shown == SPLATS]
        same = [m for m in splats if (m.cameras, m.preset, m.host) == (s.cameras, s.preset, s.host)]
        base = next((m for m in same if m.supervision == s.supervision), same[-1] if same else None)
        if base is None:
            continue
        for region in (WHOLE, "never_seen", "moving"):
            result = s.against(base, "psnr_db", region)
            if result is not None:
                rows.append([s.variant, base.label, REGION_NAMES[region], *_paired_cells(result)])
    note = "A difference below zero means that the removed part had improved the result."
    return Table("Ablations", header, rows, note)


def _real_extra(settings: Sequence[Setting]) -> Table:
    rows: list[list[str]] = []
    for s in settings:
        whole, best = s.summary("psnr_db"), s.of_frames(lambda row: row.best_90_psnr_db)
        energy = s.of_frames(lambda row: row.gradient_ratio)
        cells = [number(whole and whole.mean, "psnr_db"), number(best and best.mean, "psnr_db")]
        rows.append([s.label, *cells, plain(energy and energy.mean, 3)])
    header = [
        "method",
        "PSNR whole frame, dB",
        "PSNR best 90 % of the pixels, dB",
        "gradient energy relative to the plate",
    ]
    note = (
        "Whole frames show people who have moved since t*, which no frozen frame can match. Gradient energy: mean "
        "squared luma gradients of pixels that never move, divided by those of the plate; below 1 is softer."
    )
    return Table("Real clips: whole frame and sharpness", header, rows, note)


def number(value: float | None, metric: str) -> str:
    """A figure formatted with the digits of its metric."""
    return plain(value, _DIGITS[metric])


def pace(run: RunRecord) -> str:
    """Threads and number of runs at once during training, like "1 × 2"."""
    return NONE if run.threads is None or run.jobs is None else f"{run.threads} × {run.jobs}"


def _best(values: Sequence[float | None]) -> int | None:
    known = [(v, i) for i, v in enumerate(values) if v is not None]
    return max(known)[1] if len(known) > 1 else None


def to_be_seen(setting: Setting) -> bool:
    """True for settings in pictures of all methods: all with Gaussians alone, and ours also as delivered."""
    return setting.shown == SPLATS or (setting.shown == DELIVERED and setting.host == "auto")


def markdown(table: Table) -> str:
    """The table in Markdown, with title and note."""
    lines = [f"### {table.title}", "", "| " + " | ".join(table.header) + " |"]
    lines += ["|" + "|".join("---" if i == 0 else "---:" for i in range(len(table.header))) + "|"]
    for i, row in enumerate(table.rows):
        cells = [f"**{c}**" if i == table.best else c for c in row]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join([*lines, "", table.note, ""])
