"""The page of a comparison: one HTML file with tables and pictures, which needs no network."""

import base64
from collections.abc import Sequence
from html import escape

from spiked_service.cli.comparison.cells import Outcome
from spiked_service.cli.comparison.pictures import Strip
from spiked_service.cli.comparison.tables import NOTES, Column, columns_of, failures, grouped

LESS_IS_BETTER = {"ate_percent", "rpe_r_deg", "rpe_t_percent", "ate_unit", "rpe_r_unit_deg", "rpe_t_unit", "lpips"}
MORE_IS_BETTER = {"coverage", "psnr_db", "worst_psnr_db", "ssim"}

_STYLE = """
:root { color-scheme: light dark; --ink: #1d2330; --soft: #5a6475; --line: #d5dae3; --page: #fff; --best: #e3f0e4; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6e9ef; --soft: #a3adbd; --line: #3a4250; --page: #14171d; --best: #23402a; }
}
body { margin: 0 auto; max-width: 1500px; padding: 1.5rem; font: 15px/1.5 system-ui, sans-serif; color: var(--ink);
  background: var(--page); }
h1 { font-size: 1.5rem; margin: 0; } h2 { font-size: 1.2rem; margin: 2.5rem 0 .5rem; }
h3 { font-size: .95rem; font-weight: 500; color: var(--soft); margin: 1.2rem 0 .4rem; }
p, li { max-width: 62rem; } .soft { color: var(--soft); }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .85rem; }
th, td { padding: .3rem .55rem; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap; }
th:first-child, td.why { text-align: left; } td.why { color: var(--soft); }
td.best { background: var(--best); font-weight: 600; }
.strip { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 320px), 1fr)); gap: .8rem; }
figure { margin: 0; } img { width: 100%; display: block; border-radius: 3px; }
figcaption { font-size: .85rem; color: var(--soft); padding: .2rem 0; }
"""


def page(outcomes: Sequence[Outcome], strips: dict[str, list[Strip]], summary: Sequence[str]) -> str:
    """The whole file. `strips` by recording; `summary` are lines about the machine and the versions."""
    sections = []
    for recording, rows in grouped(outcomes).items():
        shown = "".join(_strip(strip) for strip in strips.get(recording, []))
        sections.append(f"<section><h2>{escape(recording)}</h2>{_table(rows)}{shown}</section>")
    notes = "".join(f"<li>{escape(note)}</li>" for note in NOTES)
    lines = "<br>".join(escape(line) for line in summary)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>spiked compare</title><style>{_STYLE}</style></head><body><main><h1>Comparison of methods</h1>"
        f'<p class="soft">{lines}</p>{"".join(sections)}<h2>Columns</h2><ul>{notes}</ul></main></body></html>\n'
    )


def _table(rows: dict[str, list[Outcome]]) -> str:
    columns = columns_of([outcome for cells in rows.values() for outcome in cells])
    sound = {row: [cell for cell in cells if cell.reason is None] for row, cells in rows.items()}
    best = {column.key: _best(column, list(sound.values())) for column in columns}
    head = "".join(f'<th scope="col">{escape(column.heading)}</th>' for column in columns)
    body = []
    for row, cells in rows.items():
        marked = "".join(
            f"<td{' class=best' if _is_best(column, sound[row], best[column.key]) else ''}>"
            f"{escape(column.text(sound[row]))}</td>"
            for column in columns
        )
        body.append(f'<tr><th scope="row">{escape(row)}</th>{marked}</tr>')
        why = escape("; ".join(failures(cells)))
        if why:
            body.append(f'<tr><td class="why" colspan="{len(columns) + 1}">failed: {why}</td></tr>')
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="Figures"><table><thead><tr>'
        f'<th scope="col">method</th>{head}</tr></thead>'
        f"<tbody>{''.join(body)}</tbody></table></div>"
    )


def _best(column: Column, rows: Sequence[Sequence[Outcome]]) -> float | None:
    """The best median of a column, None where nothing is better or only one row has it."""
    medians = [median for cells in rows if (median := column.median(cells)) is not None]
    if len(medians) < 2 or column.key not in LESS_IS_BETTER | MORE_IS_BETTER:
        return None
    return min(medians) if column.key in LESS_IS_BETTER else max(medians)


def _is_best(column: Column, cells: Sequence[Outcome], best: float | None) -> bool:
    """Whether a row has the best median of a column."""
    return best is not None and column.median(cells) == best


def _strip(strip: Strip) -> str:
    first = {strip.reference: strip.pictures[strip.reference]} if strip.reference in strip.pictures else {}
    figures = "".join(
        f'<figure><img alt="{escape(name)}: {escape(strip.title)}" src="data:image/webp;base64,'
        f'{base64.b64encode(data).decode()}"><figcaption>{escape(name)}</figcaption></figure>'
        for name, data in (first | strip.pictures).items()
    )
    return f'<h3>{escape(strip.title)}</h3><div class="strip">{figures}</div>'
