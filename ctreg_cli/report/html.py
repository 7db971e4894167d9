"""A run's results as one page: self-contained, no network, no library. Pure: results → text.

The charts are drawn here; the script only moves between slices and turns the 3D scene.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files

import numpy as np

from ctreg_cli._version import __version__
from ctreg_cli.io.results_document import ResultsDocument, SliceRecord, TargetRecord
from ctreg_cli.report import svg
from ctreg_cli.report.pictures import View, common_view
from ctreg_cli.report.series import COMPONENTS, pose_series, residuals
from ctreg_cli.rods import RodModel

#: slices in a page; of more, these are chosen evenly
MAX_SLICES = 2000
#: residuals drawn for one rod
MAX_DOTS = 300
NONE_OK = "<p>No slice is ok.</p>"
STATUS_WORDS = {
    "ok": "one pose explains the spots and passed every check",
    "ambiguous": "another pose explains the spots too: not to be used",
    "no_pose": "no pose was accepted",
}


def report_html(
    document: ResultsDocument, *, model: RodModel | None = None, pictures: Mapping[int, str] | None = None
) -> str:
    """The page.

    Args:
        document: what to show.
        model: the frame; without it the 3D scene has no rods.
        pictures: ``data:`` address of the slice of each index, as :func:`ctreg_cli.report.pictures.picture` makes them
            in the view of :func:`shown_view`.
    """
    records = shown_records(document)
    page = _resource("page.html")
    parts = {
        "title": escape(f"{document.model_name or 'rod frame'}: {len(document.records)} slices"),
        "style": _resource("page.css"),
        "script": _resource("page.js"),
        "data": _for_script(_data(document, records, model, pictures or {})),
        "summary": _summary(document, records),
        "strip": _strip(records),
        "curves": _curves(records),
        "residuals": _residuals(records),
        "targets": _targets(document.ok),
        "slices": _slices(records),
        "provenance": _provenance(document),
        "version": escape(__version__),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda place: parts[place[1]], page)


def shown_records(document: ResultsDocument) -> tuple[SliceRecord, ...]:
    """The slices of the page: all, or of very many an even choice."""
    records = document.records
    if len(records) <= MAX_SLICES:
        return records
    chosen = np.linspace(0, len(records) - 1, MAX_SLICES).round().astype(int)
    return tuple(records[k] for k in chosen.tolist())


def shown_view(document: ResultsDocument) -> View | None:
    """The part of the slices that the page shows."""
    return common_view(shown_records(document))


def _resource(name: str) -> str:
    return files("ctreg_cli.report").joinpath("page", name).read_text(encoding="utf-8")


def _for_script(value: object) -> str:
    """JSON that cannot end the script element it stands in."""
    text = json.dumps(value, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _data(
    document: ResultsDocument,
    records: Sequence[SliceRecord],
    model: RodModel | None,
    pictures: Mapping[int, str],
) -> dict[str, object]:
    view = shown_view(document)
    series = pose_series(tuple(records))
    return {
        "x": [round(value, 4) for value in series.x.tolist()],
        "view": None if view is None else [round(view.u0, 3), round(view.v0, 3), round(view.side_px, 3)],
        "rods": [
            {"id": rod.id, "ends": [rod.start.tolist(), rod.end.tolist()]} for rod in (model.rods if model else ())
        ],
        "targets": [{"id": t.id, "point": t.point.tolist()} for t in (model.targets if model else ())],
        "slices": [_slice_data(record, document, pictures.get(record.index)) for record in records],
    }


def _slice_data(record: SliceRecord, document: ResultsDocument, picture: str | None) -> dict[str, object]:
    scale = [_column(record, "s_x_mm"), _column(record, "s_y_mm")]
    if None in scale and document.scale is not None:
        scale = [document.scale.s_x, document.scale.s_y]
    T = record.T_slice_model
    data: dict[str, object] = {
        "i": record.index,
        "source": record.source,
        "status": record.status,
        "text": _verdict(record),
        "scale": None if None in scale else scale,
        "T": None if T is None else [float(f"{value:.7g}") for value in T[:3].ravel().tolist()],
        "spots": [
            [m.rod, round(m.u_px, 3), round(m.v_px, 3), round(m.residual_u_px, 4), round(m.residual_v_px, 4)]
            for m in record.matches
        ],
        "free": [[round(u, 3), round(v, 3)] for u, v in record.unmatched_px.tolist()],
        "missing": list(record.missing_rods),
        "tre": [[t.id, [round(c, 3) for c in t.position_slice.tolist()], round(t.tre_mm, 4)] for t in record.targets],
    }
    if picture is not None:
        data["picture"] = picture
    return data


def _column(record: SliceRecord, name: str) -> float | None:
    value = record.columns.get(name)
    return float(value) if isinstance(value, int | float) else None


def _verdict(record: SliceRecord) -> str:
    """One slice in a line."""
    words = [record.status + (f" ({record.reason})" if record.reason else "")]
    if record.T_slice_model is not None:
        n_matched, n_spots = record.columns.get("n_matched"), record.columns.get("n_spots")
        words.append(f"{n_matched} of {n_spots} spots matched")
        rms, sd = _column(record, "rms_px"), record.sd
        if rms is not None:
            words.append(f"{rms:.3g} px rms")
        if sd is not None:
            words.append(f"sd {sd[:3].max():.2g} mm, {sd[3:].max():.2g}°")
    if record.missing_rods:
        words.append(f"not seen: {', '.join(record.missing_rods)}")
    words += [f"{code.replace('_', ' ')}{': ' + text if text else ''}" for code, text in record.warnings]
    return " · ".join(words)


def _summary(document: ResultsDocument, records: Sequence[SliceRecord]) -> str:
    counts: Counter[str] = Counter(record.status for record in document.records)
    cards = [
        f'<div class="card {status}"><b>{counts[status]}</b> <span>{status}</span><small>{meaning}</small></div>'
        for status, meaning in STATUS_WORDS.items()
    ]
    reasons = Counter(record.reason for record in document.records if record.reason)
    notes = []
    if reasons:
        listed = ", ".join(f"{count} × {escape(reason)}" for reason, count in reasons.most_common())
        notes.append(f"<p>Why not: {listed}.</p>")
    if len(records) < len(document.records):
        notes.append(f"<p>This page shows {len(records)} of the {len(document.records)} slices, chosen evenly.</p>")
    return f'<div class="cards">{"".join(cards)}</div>{"".join(notes)}'


def _strip(records: Sequence[SliceRecord]) -> str:
    """A bar a slice; its height tells the status too, for those who see no colours."""
    heights = {"ok": 24, "ambiguous": 15, "no_pose": 7}
    bars = [
        f'<rect class="{record.status}" x="{k}" y="{24 - heights[record.status]}" width="1" '
        f'height="{heights[record.status]}"/>'
        for k, record in enumerate(records)
    ]
    return (
        f'<svg id="strip" viewBox="0 0 {max(len(records), 1)} 24" preserveAspectRatio="none" role="img" '
        f'aria-label="verdict of every slice">{"".join(bars)}<rect id="here" y="0" width="1" height="24"/></svg>'
    )


def _curves(records: Sequence[SliceRecord]) -> str:
    series = pose_series(tuple(records))
    if not np.isfinite(series.values).any():
        return "<p>No slice has a pose.</p>"
    usable = series.usable.tolist()
    return "".join(
        svg.curve(name, unit, series.x, series.values[:, k], series.sd[:, k], usable, series.x_name)
        for k, (name, unit) in enumerate(COMPONENTS)
    )


def _residuals(records: Sequence[SliceRecord]) -> str:
    by_rod = residuals(tuple(records))
    if not by_rod:
        if not any(record.status == "ok" for record in records):
            return NONE_OK
        return "<p>The results hold no residuals (a pose table has none; write .json).</p>"
    thinned = [values[:: -(-len(values) // MAX_DOTS)] for values in by_rod.values()]
    return svg.residuals_by_rod(list(by_rod), thinned)


def _targets(usable: Sequence[SliceRecord]) -> str:
    if not usable:
        return NONE_OK
    found: dict[str, list[TargetRecord]] = {}
    for record in usable:
        for target in record.targets:
            found.setdefault(target.id, []).append(target)
    if not found:
        return "<p>The results name no targets (the frame file may; a pose table holds none).</p>"
    rows = []
    for name, targets in found.items():
        errors = [target.tre_mm for target in targets]
        levels = [target.pl_mm for target in targets if target.pl_mm is not None]
        level = f"{max(levels):.3g}" if len(levels) == len(targets) else "none stated"
        rows.append(
            f'<tr><th scope="row">{escape(name)}</th><td>{len(targets)}</td><td>{np.median(errors):.3g}</td>'
            f"<td>{max(errors):.3g}</td><td>{level}</td></tr>"
        )
    head = (
        "<tr><th>target</th><th>ok slices</th><th>median TRE</th><th>greatest TRE</th>"
        '<th>greatest <abbr title="protection level">PL</abbr></th></tr>'
    )
    return f"<table><thead>{head}</thead><tbody>{''.join(rows)}</tbody></table>"


def _slices(records: Sequence[SliceRecord]) -> str:
    rows = [
        f'<tr><td><a href="#slice" data-at="{k}">{record.index}</a></td><td>{escape(record.source)}</td>'
        f'<td><span class="{record.status}">{record.status}</span>'
        f"{escape(_verdict(record).removeprefix(record.status))}</td></tr>"
        for k, record in enumerate(records)
    ]
    head = "<tr><th>slice</th><th>file</th><th>verdict</th></tr>"
    return f'<table class="slices"><thead>{head}</thead><tbody>{"".join(rows)}</tbody></table>'


def _provenance(document: ResultsDocument) -> str:
    rows = [
        ("results", document.name.rpartition("/")[2]),
        ("made by", f"ctreg {document.version}" if document.version else "unknown: a pose table does not say"),
        ("frame", document.model_name),
        ("frame file, SHA-256", document.model_sha256),
        ("scale", _scale_words(document)),
        *_flat("", document.options),
    ]
    body = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td>{escape(str(value))}</td></tr>'
        for name, value in rows
        if value != ""
    )
    return f'<table class="provenance"><tbody>{body}</tbody></table>'


def _scale_words(document: ResultsDocument) -> str:
    scale = document.scale
    return "" if scale is None else f"{scale.s_x:.6g} × {scale.s_y:.6g} mm/px, from {document.scale_from}"


def _flat(prefix: str, options: Mapping[str, object]) -> list[tuple[str, object]]:
    rows: list[tuple[str, object]] = []
    for name, value in options.items():
        if isinstance(value, Mapping):
            rows += _flat(f"{prefix}{name}.", value)
        else:
            rows.append((f"{prefix}{name}", value))
    return rows
