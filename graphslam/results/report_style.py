"""The style sheet of the report. Written by hand; no fonts or files are fetched."""

CSS = """
:root {
  color-scheme: light dark;
  --bg: #fbfbfa; --card: #ffffff; --ink: #1b1f24; --soft: #59626d; --grid: #dfe2e6;
  --accent: #c8601a; --warn: #fff4dc; --warn-edge: #e0a92e;
  --good: #eaf5ea; --bad: #fbe9e8;
  --robot0: #4477aa; --robot1: #ee6677; --robot2: #228833;
  --robot3: #aa3377; --robot4: #b59f1e; --robot5: #3aa9d0;
}
@media (prefers-color-scheme: dark) {
  :root {
    --bg: #14171b; --card: #1b1f24; --ink: #e4e7ea; --soft: #9aa4af; --grid: #343b43;
    --accent: #f0954f; --warn: #33290f; --warn-edge: #b98a1f;
    --good: #17271a; --bad: #34191a;
    --robot0: #7fb0e0; --robot1: #ff8c99; --robot2: #5cc46c;
    --robot3: #dd77b0; --robot4: #e0cf63; --robot5: #84d9f5;
  }
  svg image { filter: brightness(1.6); }
}
* { box-sizing: border-box; }
body { margin: 0; background: var(--bg); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
main { max-width: 1280px; margin: 0 auto; padding: 28px 24px 64px; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 .5rem; overflow-wrap: anywhere; }
h2 { font-size: 1.1rem; margin: 2.2rem 0 .8rem; }
.brand { margin: 0; color: var(--soft); font-size: .85rem; letter-spacing: .04em; }
.lead { font-size: 1.08rem; max-width: 62em; margin: 0 0 1.1rem; }
.note { color: var(--soft); font-size: .85rem; margin: .4rem 0; overflow-wrap: anywhere; }
.tiles { display: flex; flex-wrap: wrap; gap: 10px; margin: 0; }
.tiles div { background: var(--card); border: 1px solid var(--grid); border-radius: 8px;
  padding: 8px 14px; flex: 1 1 120px; }
.tiles dt { color: var(--soft); font-size: .78rem; }
.tiles dd { margin: 0; font-size: 1.25rem; font-weight: 600; font-variant-numeric: tabular-nums; }
.grid { display: grid; gap: 16px; align-items: start;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, 460px), 1fr)); }
figure { margin: 0; background: var(--card); border: 1px solid var(--grid); border-radius: 8px;
  padding: 12px 12px 6px; min-width: 0; }
figcaption { color: var(--soft); font-size: .85rem; line-height: 1.4; margin-bottom: 6px; }
figcaption b { color: var(--ink); }
figure svg { display: block; width: 100%; height: auto; color: var(--ink); }
figure svg * { stroke-linejoin: round; stroke-linecap: butt; }
svg text { fill: currentColor; }
svg .halo { paint-order: stroke; stroke: var(--card); stroke-width: 25px;
  stroke-linejoin: round; font-weight: 600; }
.live { margin-bottom: 16px; }
.live-controls { display: flex; flex-wrap: wrap; gap: 6px 22px; margin: 4px 0 8px;
  font-size: .85rem; }
.live-layers { display: flex; flex-wrap: wrap; gap: 4px 14px; align-items: center; }
.live-layers i.lane { margin: 0 5px 0 3px; }
.live-layers i.dashed { width: 34px; border-radius: 0; }
.live-range { display: flex; align-items: center; gap: 8px; flex: 1 1 300px; color: var(--soft); }
.live-range input { flex: 1 1 80px; min-width: 60px; accent-color: var(--accent); }
.live-range output { min-width: 5em; font-variant-numeric: tabular-nums; }
.live button { font: inherit; color: var(--ink); background: var(--bg); padding: 2px 10px;
  border: 1px solid var(--grid); border-radius: 6px; cursor: pointer; min-width: 6.2em; }
.live input[type=checkbox] { accent-color: var(--robot0); vertical-align: -2px; }
.live-stage { min-height: 320px; }
.warn { background: var(--warn); border-left: 4px solid var(--warn-edge); border-radius: 6px;
  padding: 10px 16px; margin-top: 1.2rem; }
.warn.good { background: var(--good); border-color: var(--robot2); }
.warn.bad { background: var(--bad); border-color: #c93c37; }
.warn p { margin: 0; }
.warn details { background: none; border: 0; padding: 0; margin: 2px 0 0; }
.warn summary { font-weight: 400; font-size: .92rem; }
.warn h2 { margin: 0 0 .2rem; font-size: .95rem; }
.warn ul { margin: 0; padding-left: 1.1rem; font-size: .92rem; overflow-wrap: anywhere; }
.accounts { display: grid; gap: 24px; align-items: start;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 280px), 1fr)); }
.scroll { overflow-x: auto; margin-bottom: 14px; }
table { border-collapse: collapse; width: 100%; font-size: .88rem;
  font-variant-numeric: tabular-nums; }
caption { text-align: left; font-weight: 600; padding-bottom: 4px; }
th, td { padding: 4px 10px 4px 0; border-bottom: 1px solid var(--grid); text-align: right;
  white-space: nowrap; }
thead th { color: var(--soft); font-weight: 500; font-size: .8rem; }
th[scope=row], thead th:first-child { text-align: left; font-weight: 400; white-space: normal; }
td.best { font-weight: 700; }
.compared th:first-child { position: sticky; left: 0; background: var(--bg); min-width: 8.5em; }
td.none { text-align: left; color: var(--soft); white-space: normal; }
i.lane { display: inline-block; width: 18px; height: 4px; border-radius: 2px; margin-right: 7px;
  vertical-align: middle; }
.lanes { display: flex; flex-wrap: wrap; gap: 4px 18px; margin: 0 0 .8rem; font-size: .88rem; }
td.bar { width: 40%; padding-right: 0; }
td.bar i { display: block; height: 8px; border-radius: 4px; background: var(--robot0); }
details { background: var(--card); border: 1px solid var(--grid); border-radius: 8px;
  padding: 10px 16px; margin-top: 14px; }
summary { cursor: pointer; font-weight: 600; }
details table { margin-top: 8px; }
code, pre { font: .82rem/1.5 ui-monospace, Menlo, Consolas, monospace; overflow-wrap: anywhere; }
pre { overflow-x: auto; background: var(--bg); padding: 12px; border-radius: 6px; }
@media (max-width: 560px) {
  main { padding: 18px 12px 40px; }
  h1 { font-size: 1.35rem; }
  figure { padding: 10px 6px 4px; }
  .tiles div { flex-basis: 100px; padding: 6px 10px; }
  .tiles dd { font-size: 1.05rem; }
  /* a wide table is folded: every row is a block, every cell has its head above it */
  table.wide thead { display: none; }
  table.wide tr { display: grid; grid-template-columns: repeat(auto-fill, minmax(104px, 1fr));
    gap: 0 10px; padding: 6px 0; border-bottom: 1px solid var(--grid); }
  table.wide :is(th, td) { display: block; border: 0; padding: 2px 0; text-align: left;
    white-space: normal; overflow-wrap: anywhere; }
  table.wide th[scope=row] { grid-column: 1 / -1; font-weight: 600; }
  table.wide td[data-label]::before { content: attr(data-label); display: block;
    color: var(--soft); font-size: .74rem; font-weight: 400; }
  table.wide td.none { grid-column: 1 / -1; }
}
@media print {
  details > * { display: block; }
  details::details-content { content-visibility: visible; block-size: auto; }
  figure, tr { break-inside: avoid; }
  main { max-width: none; }
  .live { display: none; }
}
"""
