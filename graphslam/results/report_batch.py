# ruff: noqa: RUF001 -- σ and – are meant: people read them
"""The overview of a batch: a line of numbers and a small map of each log, to be sorted."""

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import PurePath
from typing import Any
from urllib.parse import quote

from graphslam.results import report_html as html

Row = Mapping[str, Any]

#: what happened to a log, the worst first: in this order the page begins
STATES = ("failed", "bad", "doubtful", "waiting", "good")
#: key, head and title of the columns of numbers
COLUMNS = (
    ("length_m", "length", "driven by all robots of the log"),
    ("error_m", "error", "aligned error of the positions, root mean square"),
    ("sigma_m", "σ", "median standard deviation of the positions, in the worst direction"),
    ("loops", "loops", "loop closures"),
    ("warnings", "warnings", "what the result should be read with"),
    ("duration_s", "recorded", "time that the log spans"),
    ("seconds", "took", "time of the worker"),
    ("memory_mb", "memory", "largest memory of the worker with this log"),
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
.waiting i, i.waiting { background: var(--grid); }
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
    rows = sorted(found["logs"], key=lambda row: (STATES.index(state_of(row)), row["name"]))
    counts, totals = found["counts"], found["totals"]
    done = [row for row in rows if row["status"] == "done"]
    tiles = [
        ("logs", html.number(counts["logs"])),
        ("driven", _kilometres(totals["length_m"])),
        ("recorded", _hours(totals["duration_s"])),
        ("worker time", _hours(totals["seconds"])),
        ("median error", _median(done, "error_m")),
        ("median σ", _median(done, "sigma_m")),
        ("largest memory", f"{html.number(max((r['memory_mb'] for r in done), default=0.0))} MB"),
    ]
    shown = [tile for tile in tiles if tile[1] != "–"]
    sections = [
        html.header("graphslam batch", _title(counts), _lead(found), shown),
        _strip(rows),
        _tools(),
        _table(rows, maps),
        _others(found["not_recordings"]),
        f"<script>{SCRIPT}</script>",
    ]
    return html.document("Batch", sections, CSS)


def state_of(row: Row) -> str:
    """One of `STATES`: the verdict of what is done, else the status."""
    return str(row["verdict"] if row["status"] == "done" else row["status"])


def _title(counts: Mapping[str, int]) -> str:
    logs = html.counted(counts["logs"], "log")
    if counts["waiting"]:
        return f"{html.number(counts['done'] + counts['failed'])} of {logs}"
    return logs


def _lead(found: Mapping[str, Any]) -> str:
    counts = found["counts"]
    told = [f"{html.number(counts[name])} {name}" for name in ("good", "doubtful", "bad")]
    told += [f"{html.number(counts[name])} {name}" for name in ("failed", "waiting")]
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


def _tools() -> str:
    options = "".join(
        f'<option value="{key}">{escape(head)}</option>'
        for key, head in (("state", "worst first"), ("name", "name"), *(c[:2] for c in COLUMNS))
    )
    return (
        f'<div class="tools" hidden><label>sort by <select>{options}</select></label>'
        '<input type="search" placeholder="find a log, a robot, a warning" '
        'aria-label="find"><output class="note"></output></div>'
    )


def _table(rows: Sequence[Row], maps: Mapping[str, str]) -> str:
    used = [c for c in COLUMNS if any(row.get(c[0]) is not None for row in rows)]
    heads = '<th scope="col">map</th>' + "".join(
        f'<th scope="col" data-key="{key}" title="{escape(title)}">'
        f'<button type="button">{escape(head)}</button></th>'
        for key, head, title in (("name", "log", "worst first, until sorted otherwise"), *used)
    )
    body = "".join(_row(row, maps.get(row["name"], ""), used) for row in rows)
    return (
        f'<table class="batch wide"><thead><tr>{heads}</tr></thead>\n<tbody>{body}</tbody></table>'
    )


def _row(row: Row, drawing: str, used: Iterable[tuple[str, str, str]]) -> str:
    state, name = state_of(row), escape(row["name"])
    if row["status"] == "done":
        link = quote(f"results/{row['name']}/report.html")
        name = f'<a href="{link}">{name}</a>'
    else:
        name = f"<b>{name}</b>"
    told = [row["error"]] if row["error"] else [*row.get("reasons", ()), *row.get("warnings", ())]
    # a report tells of no machine
    files = [row["path"], *(file["path"] for file in row.get("files", ()))]
    why = escape(html.without_folders("; ".join(dict.fromkeys(told)), files))
    values = {key: _sortable(row.get(key)) for key, *_ in used}
    data = "".join(f' data-{key}="{value}"' for key, value in values.items())
    cells = "".join(
        f'<td data-label="{escape(head)}">{_cell(key, row.get(key))}</td>' for key, head, _ in used
    )
    return (
        f'<tr data-is="{state}" data-state="{STATES.index(state)}" '
        f'data-name="{escape(row["name"])}"{data}>'
        f'<td class="map">{drawing or "<span>no result</span>"}</td>'
        f'<th scope="row" class="log">{name}<span class="badge {state}"><i></i>{state}</span>'
        f"{f'<span class=why>{why}</span>' if why else ''}</th>{cells}</tr>\n"
    )


def _sortable(value: object) -> str:
    if value is None:
        return ""
    return str(len(value) if isinstance(value, list) else value)


def _cell(key: str, value: Any) -> str:
    """A number with its unit."""
    if value is None:
        return "–"
    if key in ("error_m", "sigma_m"):
        return html.length(float(value))
    if key == "length_m":
        return f"{html.number(float(value))} m"
    if key in ("duration_s", "seconds"):
        return html.duration(float(value))
    if key == "memory_mb":
        return f"{html.number(float(value))} MB"
    return html.number(len(value) if isinstance(value, list) else value)


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
