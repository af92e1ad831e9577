# ruff: noqa: RUF001 -- σ and – are meant: people read them
"""The overview of a batch: a line of numbers and a small map of each log, to be sorted."""

from collections.abc import Callable, Mapping, Sequence
from html import escape
from pathlib import PurePath
from typing import Any, NamedTuple
from urllib.parse import quote

from graphslam.results import report_html as html

Row = Mapping[str, Any]

#: what happened to a log, the worst first: in this order the page begins
STATES = ("failed", "bad", "doubtful", "waiting", "good", "done")


class Column(NamedTuple):
    """A column of numbers: its head and title, the number in a row, and that as text."""

    head: str
    title: str
    value: Callable[[Row], float | None]
    text: Callable[[float], str]


def _count_of(row: Row) -> float | None:
    return len(row["warnings"]) if "warnings" in row else None


def megabytes(value: float) -> str:
    """A size of memory for reading."""
    return f"{html.number(value)} MB"


COLUMNS = (
    Column(
        "length",
        "driven by all robots of the log",
        lambda row: row.get("length_m"),
        lambda value: f"{html.number(float(value))} m",
    ),
    Column(
        "error",
        "aligned error of the positions, root mean square",
        lambda row: row.get("error_m"),
        html.length,
    ),
    Column(
        "σ",
        "median standard deviation of the positions, in the worst direction",
        lambda row: row.get("sigma_m"),
        html.length,
    ),
    Column("loops", "loop closures", lambda row: row.get("loops"), html.number),
    Column("warnings", "what the result should be read with", _count_of, html.number),
    Column("recorded", "time of the log", lambda row: row.get("duration_s"), html.duration),
    Column("took", "time of the worker", lambda row: row.get("seconds"), html.duration),
    Column("memory", "most memory of the worker", lambda row: row.get("memory_mb"), megabytes),
)

CSS = """
.fleet { display: flex; height: 14px; border-radius: 7px; overflow: hidden; margin: 18px 0 6px;
  gap: 2px; }
.fleet i { display: block; min-width: 4px; }
.states { display: flex; flex-wrap: wrap; gap: 6px; margin: 0 0 14px; align-items: center; }
.states button, .tools select, .tools input { font: inherit; font-size: .86rem; color: var(--ink);
  background: var(--card); border: 1px solid var(--grid); border-radius: 999px; padding: 3px 12px; }
.states button { cursor: pointer; }
.states button[aria-pressed=true] { border-color: var(--ink); box-shadow: 0 0 0 1px var(--ink); }
.states button i, .badge i { display: inline-block; width: 9px; height: 9px; border-radius: 50%;
  margin-right: 6px; }
.tools { display: flex; flex-wrap: wrap; gap: 8px; margin: 0 0 10px; align-items: center; }
.tools[hidden] { display: none; }
.tools label { color: var(--soft); font-size: .84rem; }
.tools input { flex: 1 1 160px; min-width: 120px; max-width: 340px; }
.good i, i.good { background: var(--robot2); } .doubtful i, i.doubtful { background: #d9a21b; }
.bad i, i.bad { background: #c93c37; } .failed i, i.failed { background: #7a1f6b; }
.done i, i.done { background: var(--robot0); } .waiting i, i.waiting { background: var(--grid); }
@media (prefers-color-scheme: dark) { .failed i, i.failed { background: #d67ac6; } }
.batch td, .batch th { vertical-align: middle; }
.batch thead th:nth-child(2) { text-align: left; }
.batch thead th { position: sticky; top: 0; background: var(--bg); z-index: 1; }
.batch thead button { font: inherit; color: inherit; background: none; border: 0; padding: 0;
  cursor: pointer; }
.batch thead [aria-sort=ascending] button::after { content: " ↑"; color: var(--accent); }
.batch thead [aria-sort=descending] button::after { content: " ↓"; color: var(--accent); }
.batch td.map { width: 128px; padding: 4px 12px 4px 0; }
.batch td.map svg, .batch td.map span { display: block; width: 120px; height: 90px;
  background: var(--card); border: 1px solid var(--grid); border-radius: 6px; }
.batch th.log { min-width: 15em; max-width: 30em; white-space: normal; overflow-wrap: anywhere;
  text-align: left; padding-right: 18px; }
.batch th.log a, .batch th.log b { font-weight: 600; color: var(--ink); }
.batch .why { font-weight: 400; color: var(--soft); font-size: .8rem; line-height: 1.35;
  margin-top: 3px; display: -webkit-box; -webkit-line-clamp: 3; -webkit-box-orient: vertical;
  overflow: hidden; }
.batch td.map span { display: grid; place-items: center; color: var(--soft);
  font-size: .8rem; border-style: dashed; background: none; }
.badge { display: inline-block; font-size: .8rem; color: var(--soft); margin-left: 8px;
  white-space: nowrap; }
@media (max-width: 560px) {
  .batch, .batch tbody { display: block; }
  .batch tr { position: relative; grid-template-columns: repeat(4, minmax(0, 1fr)) !important;
    padding: 12px 0 !important; }
  .batch tr[hidden] { display: none !important; }
  .batch td.map { grid-column: 1 / 3; grid-row: 1; width: auto; padding-right: 8px !important; }
  .batch td.map svg, .batch td.map span { width: 100%; height: auto; aspect-ratio: 4 / 3; }
  .batch th.log { grid-column: 3 / -1 !important; grid-row: 1; min-width: 0; padding: 0; }
  .batch .badge { display: block; margin: 3px 0 0; }
  .batch .why { -webkit-line-clamp: 4; }
  .batch tr[data-is=failed] td[data-label], .batch tr[data-is=waiting] td[data-label]
    { display: none; }
}
"""

#: sorting, and choosing by state and name; without scripts the page shows all, the worst first
SCRIPT = """
(() => {
  const table = document.querySelector("table.batch");
  if (!table) return;
  const body = table.tBodies[0], rows = [...body.rows];
  const heads = [...table.tHead.querySelectorAll("th[data-key]")];
  const choice = document.querySelector(".tools select");
  const search = document.querySelector(".tools input");
  const states = [...document.querySelectorAll(".states button")];
  const count = document.querySelector(".tools output");
  let state = "", key = "state", up = true;
  const value = row => {
    const text = row.dataset[key];
    return text === "" ? null : Number(text);
  };
  const byName = (a, b) => a.dataset.name.localeCompare(b.dataset.name, undefined, {numeric: true});
  const compare = (a, b) => {
    if (key === "name") return up ? byName(a, b) : byName(b, a);
    const x = value(a), y = value(b);
    if (x === null || y === null) return (x === null) - (y === null) || byName(a, b);
    return (up ? x - y : y - x) || byName(a, b);
  };
  const show = () => {
    body.append(...[...rows].sort(compare));
    const wanted = search.value.trim().toLowerCase();
    let shown = 0;
    for (const row of rows) {
      row.hidden = Boolean(state && row.dataset.is !== state) ||
        !row.textContent.toLowerCase().includes(wanted);
      shown += !row.hidden;
    }
    count.textContent = shown < rows.length ? `${shown} of ${rows.length}` : "";
    for (const head of heads)
      head.setAttribute("aria-sort",
        head.dataset.key !== key ? "none" : up ? "ascending" : "descending");
    choice.value = key;
    for (const one of states) one.setAttribute("aria-pressed", one.dataset.state === state);
  };
  const sortBy = name => {
    up = name === key ? !up : name === "name" || name === "state";
    key = name;
    show();
  };
  for (const head of heads)
    head.querySelector("button").addEventListener("click", () => sortBy(head.dataset.key));
  choice.addEventListener("change", () => sortBy(choice.value));
  search.addEventListener("input", show);
  for (const one of states)
    one.addEventListener("click", () => {
      state = state === one.dataset.state ? "" : one.dataset.state;
      show();
    });
  document.querySelector(".tools").hidden = false;
  show();
})();
"""


def batch_page(found: Mapping[str, Any], maps: Mapping[str, str]) -> str:
    """The page of an overview; ``maps``: SVG by the name of the log, as far as there are any."""
    totals = found["totals"]
    done = [row for row in found["logs"] if row["status"] == "done"]
    tiles = [
        ("logs", html.number(found["counts"]["logs"])),
        ("driven", _kilometres(totals["length_m"])),
        ("recorded", _hours(totals["duration_s"])),
        ("worker time", _hours(totals["seconds"])),
        ("median error", _median(done, "error_m")),
        ("median σ", _median(done, "sigma_m")),
        ("most memory", megabytes(max((r["memory_mb"] for r in done), default=0.0))),
    ]
    return overview_page("graphslam batch", found, maps, tiles, COLUMNS)


def overview_page(
    brand: str,
    found: Mapping[str, Any],
    maps: Mapping[str, str],
    tiles: Sequence[tuple[str, str]],
    columns: Sequence[Column],
    above: str = "",
) -> str:
    """A page with a line of each log; ``above``: HTML above these lines."""
    rows = sorted(found["logs"], key=lambda row: (STATES.index(state_of(row)), row["name"]))
    used = [c for c in columns if any(c.value(row) is not None for row in rows)]
    sections = [
        html.header(
            brand, _title(found["counts"]), _lead(found), [t for t in tiles if t[1] != "–"]
        ),
        above,
        _strip(rows),
        _tools(used),
        _table(rows, maps, used),
        _others(found["not_recordings"]),
        f"<script>{SCRIPT}</script>",
    ]
    return html.document("Batch", sections, CSS)


def state_of(row: Row) -> str:
    """One of `STATES`: the verdict of what is done, if nothing of it failed, else the status."""
    if row["error"]:
        return "failed"
    return str((row["status"] == "done" and row.get("verdict")) or row["status"])


def _title(counts: Mapping[str, int]) -> str:
    logs = html.counted(counts["logs"], "log")
    if counts["waiting"]:
        return f"{html.number(counts['done'] + counts['failed'])} of {logs}"
    return logs


def _lead(found: Mapping[str, Any]) -> str:
    counts = found["counts"]
    verdicts = [name for name in ("good", "doubtful", "bad") if counts[name]]
    names = [*(verdicts or ["done"]), "failed", "waiting"]
    told = [f"{html.number(counts[name])} {name}" for name in names]
    words = [text for text in told if not text.startswith("0 ")]
    who = f", by {found['workers']}" if found.get("workers") else ""
    last = f"The last run did {html.number(counts['done_now'])} of them in "
    last += f"{html.duration(float(found['seconds']))}{who}." if counts["done_now"] else ""
    return f"{', '.join(words)}. {last if counts['done_now'] else ''}"


def _strip(rows: Sequence[Row]) -> str:
    """The share of each state as a bar, and buttons that choose one."""
    counts = {name: sum(state_of(row) == name for row in rows) for name in STATES}
    there = {name: count for name, count in counts.items() if count}
    bar = "".join(f'<i class="{name}" style="flex:{count}"></i>' for name, count in there.items())
    buttons = "".join(
        f'<button type="button" class="{name}" data-state="{name}" aria-pressed="false">'
        f"<i></i>{name} {html.number(count)}</button>"
        for name, count in there.items()
    )
    return f'<div class="fleet" aria-hidden="true">{bar}</div><div class="states">{buttons}</div>'


def _tools(columns: Sequence[Column]) -> str:
    choices = [("state", "worst first"), ("name", "name")]
    choices += [(f"c{k}", column.head) for k, column in enumerate(columns)]
    options = "".join(f'<option value="{key}">{escape(head)}</option>' for key, head in choices)
    return (
        f'<div class="tools" hidden><label>sort by <select>{options}</select></label>'
        '<input type="search" placeholder="find a log, a robot, a warning" '
        'aria-label="find"><output class="note"></output></div>'
    )


def _table(rows: Sequence[Row], maps: Mapping[str, str], columns: Sequence[Column]) -> str:
    heads = [("name", "log", "worst first, until sorted otherwise")]
    heads += [(f"c{k}", column.head, column.title) for k, column in enumerate(columns)]
    top = '<th scope="col">map</th>' + "".join(
        f'<th scope="col" data-key="{key}" title="{escape(title)}">'
        f'<button type="button">{escape(head)}</button></th>'
        for key, head, title in heads
    )
    body = "".join(_row(row, maps.get(row["name"], ""), columns) for row in rows)
    return f'<table class="batch wide"><thead><tr>{top}</tr></thead>\n<tbody>{body}</tbody></table>'


def _row(row: Row, drawing: str, columns: Sequence[Column]) -> str:
    state, name = state_of(row), escape(row["name"])
    if row["status"] == "done":
        link = quote(f"results/{row['name']}/report.html")
        name = f'<a href="{link}">{name}</a>'
    else:
        name = f"<b>{name}</b>"
    backends = row.get("backends", {}).items()
    failed = [f"{spec}: {one['error']}" for spec, one in backends if one["error"]]
    told = failed or [row["error"] or "", *row.get("reasons", ())]
    told += row.get("warnings", ())
    # a report tells of no machine
    files = [row["path"], *(file["path"] for file in row.get("files", ()))]
    why = escape(html.without_folders("; ".join(dict.fromkeys(filter(None, told))), files))
    values = [column.value(row) for column in columns]
    data = "".join(
        f' data-c{k}="{"" if value is None else value}"' for k, value in enumerate(values)
    )
    cells = "".join(
        f'<td data-label="{escape(column.head)}">'
        f"{'–' if value is None else column.text(value)}</td>"
        for column, value in zip(columns, values, strict=True)
    )
    return (
        f'<tr data-is="{state}" data-state="{STATES.index(state)}" '
        f'data-name="{escape(row["name"])}"{data}>'
        f'<td class="map">{drawing or "<span>no result</span>"}</td>'
        f'<th scope="row" class="log">{name}<span class="badge {state}"><i></i>{state}</span>'
        f"{f'<span class=why>{why}</span>' if why else ''}</th>{cells}</tr>\n"
    )


def _others(paths: Sequence[str]) -> str:
    """Files of the folders that are no recordings."""
    if not paths:
        return ""
    names = ", ".join(escape(PurePath(path).name) for path in paths)
    count = html.counted(len(paths), "file")
    return html.details(f"{count} passed over: not a recording", f"<p class=note>{names}</p>")


def _median(rows: Sequence[Row], key: str) -> str:
    values = sorted(float(row[key]) for row in rows if row.get(key) is not None)
    return html.length(values[len(values) // 2]) if values else "–"


def _kilometres(length_m: float) -> str:
    if length_m < 1000:
        return f"{html.number(float(length_m))} m"
    return f"{html.number(length_m / 1000)} km"


def _hours(seconds: float) -> str:
    return html.duration(seconds) if seconds < 7200 else f"{html.number(seconds / 3600)} h"
